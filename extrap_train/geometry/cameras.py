"""Projection between pixels and space."""

import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.views import Camera


def pixel_grid(
    height: int, width: int, device: torch.device | str = "cpu"
) -> Float[Tensor, "h w 2"]:
    """Pixel centres (u, v) of an image."""
    v, u = torch.meshgrid(
        torch.arange(height, device=device) + 0.5,
        torch.arange(width, device=device) + 0.5,
        indexing="ij",
    )
    return torch.stack([u, v], -1)


def unproject(depth: Float[Tensor, "*b h w"], camera: Camera) -> Float[Tensor, "*b h w 3"]:
    """Each pixel's point in the camera's frame; pixels of depth 0 land at the origin."""
    grid = pixel_grid(camera.height, camera.width, depth.device).to(depth.dtype)
    k = camera.intrinsics[..., None, None, :, :]
    x = (grid[..., 0] - k[..., 0, 2]) / k[..., 0, 0] * depth
    y = (grid[..., 1] - k[..., 1, 2]) / k[..., 1, 1] * depth
    return torch.stack([x, y, depth], -1)


def unproject_to_world(depth: Float[Tensor, "*b h w"], camera: Camera) -> Float[Tensor, "*b h w 3"]:
    """Each pixel's point in the world; pixels of depth 0 land at the camera's centre."""
    return transform(camera.cam_to_world[..., None, :, :], unproject(depth, camera))


def transform(
    matrix: Float[Tensor, "*#b 4 4"], points: Float[Tensor, "*b n 3"]
) -> Float[Tensor, "*b n 3"]:
    """Apply a rigid (or any affine) transform to points."""
    return points @ matrix[..., :3, :3].mT + matrix[..., None, :3, 3]


def project(
    points: Float[Tensor, "*b n 3"], camera: Camera
) -> tuple[Float[Tensor, "*b n 2"], Float[Tensor, "*b n"]]:
    """World points to pixels (u, v) and depth; where depth ≤ 0 the pixel means nothing."""
    cam = transform(camera.world_to_cam, points)
    depth = cam[..., 2]
    k = camera.intrinsics
    safe = torch.where(depth.abs() < 1e-12, torch.ones_like(depth), depth)
    u = k[..., 0, 0, None] * cam[..., 0] / safe + k[..., 0, 2, None]
    v = k[..., 1, 1, None] * cam[..., 1] / safe + k[..., 1, 2, None]
    return torch.stack([u, v], -1), depth
