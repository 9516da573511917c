"""Splatting three references into a query, projection included."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.perf.timing import Row, compare
from benchmarks.perf.warp_reference import splat_reference
from extrap_train.geometry.cameras import unproject_to_world
from extrap_train.geometry.splat import splat
from extrap_train.views import Camera

CHANNELS = 7
"""Colour, reference coordinates, depth, and which reference: what a warp carries."""
SIZES = (256, 512)
ANGLES_DEG = (0.0, -30.0, 40.0)
QUERY_ANGLE_DEG = 15.0


def run() -> list[Row]:
    """One row an image size; on the GPU, too, where there is one."""
    names = ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]
    return [_compare(size, torch.device(name)) for name in names for size in SIZES]


def _compare(size: int, device: torch.device) -> Row:
    points, values = (x.to(device) for x in bumpy_views(size))
    query = orbit_camera(QUERY_ANGLE_DEG, size).to(device)

    return compare(
        f"{len(ANGLES_DEG)} references, {size}x{size}, {CHANNELS} channels",
        device,
        lambda: splat(points, values, query).means,
        lambda: splat_reference(points, values, query).permute(2, 0, 1),
    )


def bumpy_views(size: int) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n c"]]:
    """World points of three views of a bumpy ball before a wall, with random values."""
    depth = bumpy_depth(size)
    points = [unproject_to_world(depth, orbit_camera(angle, size)) for angle in ANGLES_DEG]
    generator = torch.Generator().manual_seed(0)
    values = torch.rand(len(points) * size * size, CHANNELS, generator=generator)
    return torch.cat([x.reshape(-1, 3) for x in points]), values


def bumpy_depth(size: int) -> Float[Tensor, "h w"]:
    """Depth of a bumpy ball before a wall."""
    v, u = torch.meshgrid(*2 * [torch.linspace(-1, 1, size)], indexing="ij")
    ball = (0.5 - u.square() - v.square()).clamp(min=0).sqrt()
    depth = 3.0 - 1.2 * ball + 0.05 * torch.sin(9 * u) * torch.cos(7 * v)
    return torch.where(ball > 0, depth, 4.0)


def orbit_camera(azimuth_deg: float, size: int) -> Camera:
    """A camera that looks at the origin from a distance of 3."""
    c, s = math.cos(math.radians(azimuth_deg)), math.sin(math.radians(azimuth_deg))
    world_to_cam = torch.tensor(
        [[c, 0.0, s, 0.0], [0.0, 1.0, 0.0, 0.0], [-s, 0.0, c, 3.0], [0.0, 0.0, 0.0, 1.0]]
    )
    intrinsics = torch.tensor([[1.2 * size, 0, size / 2], [0, 1.2 * size, size / 2], [0, 0, 1]])
    return Camera(world_to_cam, intrinsics, size, size)
