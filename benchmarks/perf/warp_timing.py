"""Splatting three references into a query, projection included; and how much of its rays they leave
unobserved.
"""

import math
from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.perf.timing import Timing, compare, devices
from extrap_train.geometry.cameras import unproject_to_world
from extrap_train.geometry.visibility import Ball, Visibility, trace_torch, trace_visibility
from extrap_train.geometry.warp import splat_points
from extrap_train.geometry.warp.splat import DEPTH_SHARPNESS
from extrap_train.views import Camera, stack_cameras

CHANNELS = 7
"""Colour, reference coordinates, depth, and which reference: what a warp carries."""
SIZES = (256, 512)
VISIBILITY_SIZES = (128, 256)
ANGLES_DEG = (0.0, -30.0, 40.0)
QUERY_ANGLE_DEG = 15.0


def run() -> list[Timing]:
    """Rows for every image size; on the GPU, too, where there is one."""
    rows = [_compare_splats(size, device) for device in devices() for size in SIZES]
    return [*rows, *(_compare_visibility(size) for size in VISIBILITY_SIZES)]


def _compare_splats(size: int, device: torch.device) -> Timing:
    points, values = (x.to(device) for x in bumpy_views(size))
    query = orbit_camera(QUERY_ANGLE_DEG, size).to(device)

    return compare(
        f"{len(ANGLES_DEG)} references, {size}x{size}, {CHANNELS} channels",
        device,
        lambda: splat_points(points, values, query),
        lambda: splat_reference(points, values, query).permute(2, 0, 1),
    )


def _compare_visibility(size: int) -> Timing:
    """Unobserved space along the rays of a query from aside; on the CPU, where there are two
    implementations of it."""
    references = stack_cameras([orbit_camera(angle, size) for angle in ANGLES_DEG])
    cameras, query = stack_cameras([references]), stack_cameras([orbit_camera(120.0, size)])
    depths = bumpy_depth(size).expand(1, len(ANGLES_DEG), size, size).contiguous()
    valid = torch.ones(1, len(ANGLES_DEG), dtype=torch.bool)
    surface, ball = torch.zeros(1, size, size), Ball.around(references)

    def trace(implementation: Callable[..., Visibility]) -> Float[Tensor, "b h w"]:
        return implementation(depths, cameras, valid, query, surface, ball).unobserved

    return compare(
        f"unobserved space, {len(ANGLES_DEG)} references, {size}x{size}",
        torch.device("cpu"),
        lambda: trace(trace_visibility),
        lambda: trace(trace_torch),
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


def splat_reference(
    world_points: Float[Tensor, "n 3"], values: Float[Tensor, "n c"], camera: Camera
) -> Float[Tensor, "h w c1"]:
    """Softmax splatting as one writes it in plain torch: four corners, `index_add_`.

    Mean values and, as the last channel, the summed weight, as `geometry.warp.splat`
    defines them."""
    x, y, z = world_points.unbind(-1)
    rows = camera.intrinsics @ camera.world_to_cam[:3]
    u, v, depth = (row[0] * x + row[1] * y + row[2] * z + row[3] for row in rows)
    u, v = u / depth - 0.5, v / depth - 0.5
    left, top = u.floor(), v.floor()
    h, w = camera.height, camera.width
    corners = []
    for dx in (0, 1):
        for dy in (0, 1):
            column, row = left + dx, top + dy
            kernel = (1 - (u - column).abs()) * (1 - (v - row).abs())
            inside = (
                (depth > 0) & (column >= 0) & (column < w) & (row >= 0) & (row < h) & (kernel > 0)
            )
            pixel = torch.where(inside, row * w + column, h * w).long()
            corners.append((pixel, torch.where(inside, kernel, 0)))
    nearest = torch.full((h * w + 1,), torch.inf, device=z.device)
    for pixel, _ in corners:
        nearest.scatter_reduce_(0, pixel, depth, "amin")
    total = torch.zeros(h * w + 1, values.shape[1] + 1, device=z.device)
    weighted = torch.cat([values, torch.ones_like(values[:, :1])], 1)
    for pixel, kernel in corners:
        near = nearest[pixel]
        weight = kernel * torch.exp(-DEPTH_SHARPNESS * (depth - near) / near)
        total.index_add_(0, pixel, weighted * weight[:, None])
    total = total[:-1].reshape(h, w, -1)
    weight = total[..., -1:]
    return torch.cat([total[..., :-1] / torch.where(weight > 0, weight, 1), weight], -1)
