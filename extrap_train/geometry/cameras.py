"""Pixels, points and worlds: projection both ways, and a world centred on the scene."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.views import Camera, View


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


def coordinate_grid(
    height: int, width: int, device: torch.device | str = "cpu"
) -> Float[Tensor, "2 h w"]:
    """Normalised (u, v) of every pixel centre of an image, in (−1, 1)."""
    size = torch.tensor([width, height], device=device)
    return (pixel_grid(height, width, device) / size * 2 - 1).permute(2, 0, 1)


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


@dataclass(frozen=True)
class WorldFrame:
    """A normalised world, centred on the scene: `x_outside = unit · x_inside + center`.

    Thresholds mean the same in it whatever unit and origin the photographs' poses have. Computed in
    double precision.
    """

    center: Float[Tensor, "3"]
    """In the photographs' world."""
    unit: float
    """Length of 1 of the frame, in the photographs' world."""

    def inside(self, camera: Camera) -> Camera:
        """A camera (or batch) of the photographs' world in the frame."""
        matrix, center = camera.world_to_cam.double(), self.center.to(camera.world_to_cam.device)
        shift = matrix[..., :3, :3] @ center.double() + matrix[..., :3, 3]
        return _with_translation(camera, shift / self.unit)

    def outside(self, camera: Camera) -> Camera:
        """A camera (or batch) of the frame in the photographs' world."""
        matrix, center = camera.world_to_cam.double(), self.center.to(camera.world_to_cam.device)
        shift = matrix[..., :3, 3] * self.unit - matrix[..., :3, :3] @ center.double()
        return _with_translation(camera, shift)

    def view_inside(self, view: View) -> View:
        """A posed photograph in the frame, its depth with it."""
        depth = None if view.depth is None else view.depth / self.unit
        return replace(view, camera=self.inside(view.camera), depth=depth)

    def points_outside(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Points of the frame in the photographs' world."""
        center = self.center.to(points.device).double()
        return (points.double() * self.unit + center).to(points.dtype)


def _with_translation(camera: Camera, translation: Float[Tensor, "*b 3"]) -> Camera:
    matrix = camera.world_to_cam.clone()
    matrix[..., :3, 3] = translation.to(matrix.dtype)
    return replace(camera, world_to_cam=matrix)
