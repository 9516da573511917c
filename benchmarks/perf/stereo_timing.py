"""The expensive parts of plane-sweep stereo, against their definitions in plain torch."""

import torch

from benchmarks.perf.timing import Timing, compare
from benchmarks.perf.warp_timing import ANGLES_DEG, bumpy_depth, orbit_camera
from extrap_train.depth.photo_cost import CHUNK_ELEMENTS, PhotoCost
from extrap_train.depth.plane_sweep import semi_global_cost, semi_global_torch
from extrap_train.views import View

SIZES = (128, 256)
PLANES = 96


def run() -> list[Timing]:
    """Rows for every image size; on the CPU, where there are two implementations."""
    return [row for size in SIZES for row in _compare(size)]


def _compare(size: int) -> list[Timing]:
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(3, size, size, generator=generator)
    view, *others = (View(image, orbit_camera(angle_deg, size)) for angle_deg in ANGLES_DEG)
    depth = bumpy_depth(size)
    inverse_depth = torch.linspace(1 / depth.max(), 1 / depth.min(), PLANES)
    inverse_depth = inverse_depth[:, None, None].expand(PLANES, size, size).contiguous()
    cost = PhotoCost(view, others)
    costs = cost(inverse_depth)
    chunks = inverse_depth.split(max(1, CHUNK_ELEMENTS // (image.numel() * len(others))))
    device = torch.device("cpu")
    case = f"{PLANES} planes, {size}x{size}"
    return [
        compare(
            f"matching cost against {len(others)} views, {case}",
            device,
            lambda: cost(inverse_depth),
            lambda: torch.cat([cost.cost_torch(chunk) for chunk in chunks]),
        ),
        compare(
            f"semi-global sums, {case}",
            device,
            lambda: semi_global_cost(costs, image),
            lambda: semi_global_torch(costs, image),
        ),
    ]
