"""Analytic scenes with exact answers: depth, colour and visibility by intersecting rays."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from extrap_train.geometry.cameras import pixel_grid, transform
from extrap_train.views import Camera

Hit = Callable[[Tensor, Tensor], Tensor]
"""Distances along rays (origins n 3, directions n 3) → n; infinite where they miss."""


@dataclass(frozen=True)
class Scene:
    """Solid shapes in a world of unit scale, centred at the origin, with a smooth texture in
    space."""

    shapes: tuple[Hit, ...]

    def hit(self, origins: Tensor, directions: Tensor) -> Tensor:
        return torch.stack([shape(origins, directions) for shape in self.shapes]).amin(0)

    def depth(self, camera: Camera) -> Float[Tensor, "h w"]:
        """Exact depth at pixel centres; 0 where nothing is hit."""
        origins, directions = rays(camera)
        distance = self.hit(origins, directions)
        depth = torch.where(torch.isfinite(distance), distance, 0)
        return depth.reshape(camera.height, camera.width).float()

    def image(self, camera: Camera) -> Float[Tensor, "3 h w"]:
        origins, directions = rays(camera)
        distance = self.hit(origins, directions)
        points = origins + directions * torch.where(torch.isfinite(distance), distance, 0)[:, None]
        return texture(points).T.reshape(3, camera.height, camera.width).float()

    def visible_from(self, other: Camera, camera: Camera) -> Bool[Tensor, "h w"]:
        """Which pixels of `camera` show a point that lies inside `other`'s image and is not
        hidden from it."""
        origins, directions = rays(camera)
        distance = self.hit(origins, directions)
        hit = torch.isfinite(distance)
        points = origins + directions * torch.where(hit, distance, 0)[:, None]
        centre = other.center.double()
        to_point = points - centre
        unhidden = self.hit(centre.expand_as(points), to_point) > 1 - 1e-6
        cam = transform(other.world_to_cam.double(), points)
        pixel = cam @ other.intrinsics.double().T
        uv = pixel[:, :2] / pixel[:, 2:]
        inside = (
            (uv > 0.5).all(1) & (uv[:, 0] < other.width - 0.5) & (uv[:, 1] < other.height - 0.5)
        )
        return (hit & unhidden & inside & (cam[:, 2] > 0)).reshape(camera.height, camera.width)


def rays(camera: Camera) -> tuple[Tensor, Tensor]:
    """World rays through the pixel centres; the directions have depth 1."""
    grid = pixel_grid(camera.height, camera.width).reshape(-1, 2).double()
    pixel = torch.cat([grid, torch.ones(len(grid), 1, dtype=torch.float64)], 1)
    cam = pixel @ torch.linalg.inv(camera.intrinsics.double()).T
    directions = cam @ camera.cam_to_world[:3, :3].double().T
    return camera.center.double().expand_as(directions), directions


def texture(points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Colours that vary smoothly in space, in [0.1, 0.9]."""
    waves = torch.tensor([[2.5, 1.5, 2.0], [-2.0, 3.0, 1.0], [1.5, -2.5, 3.0]], dtype=points.dtype)
    return 0.5 + 0.4 * torch.sin(
        points @ waves.T + torch.tensor([0.3, 1.1, 2.0], dtype=points.dtype)
    )


def plane(offset: float, normal: tuple[float, float, float] = (0.0, 0.0, 1.0)) -> Hit:
    """The plane normal·x = offset."""

    def hit(origins: Tensor, directions: Tensor) -> Tensor:
        n = origins.new_tensor(normal)
        distance = (offset - origins @ n) / (directions @ n)
        return torch.where(distance > 1e-9, distance, torch.inf)

    return hit


def sphere(radius: float, center: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Hit:
    def hit(origins: Tensor, directions: Tensor) -> Tensor:
        o = origins - origins.new_tensor(center)
        a, b = directions.square().sum(1), (o * directions).sum(1)
        root = b.square() - a * (o.square().sum(1) - radius**2)
        near = (-b - root.clamp(min=0).sqrt()) / a
        return torch.where((root > 0) & (near > 1e-9), near, torch.inf)

    return hit


def box(lower: tuple[float, float, float], upper: tuple[float, float, float]) -> Hit:
    def hit(origins: Tensor, directions: Tensor) -> Tensor:
        first = (origins.new_tensor(lower) - origins) / directions
        second = (origins.new_tensor(upper) - origins) / directions
        enter = torch.minimum(first, second).amax(1)
        leave = torch.maximum(first, second).amin(1)
        return torch.where((enter < leave) & (enter > 1e-9), enter, torch.inf)

    return hit


def orbit_camera(
    azimuth_deg: float,
    distance: float = 3.0,
    elevation_deg: float = 10.0,
    size: int = 128,
    focal: float = 1.2,
) -> Camera:
    """A camera on a circle around the origin, looking at it; azimuth 0 looks along +z, world +y
    is down."""
    azimuth, elevation = torch.deg2rad(
        torch.tensor([azimuth_deg, elevation_deg], dtype=torch.float64)
    )
    forward = torch.stack(
        [-azimuth.sin() * elevation.cos(), elevation.sin(), azimuth.cos() * elevation.cos()]
    )
    right = torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64), forward)
    right = right / right.norm()
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    world_to_cam = torch.eye(4, dtype=torch.float64)
    world_to_cam[:3, :3], world_to_cam[:3, 3] = rotation, torch.tensor([0.0, 0.0, distance])
    intrinsics = torch.tensor(
        [[focal * size, 0, size / 2], [0, focal * size, size / 2], [0, 0, 1]], dtype=torch.float64
    )
    return Camera(world_to_cam.float(), intrinsics.float(), size, size)


def scaled(camera: Camera, factor: float) -> Camera:
    """The same camera in a world measured in another unit."""
    world_to_cam = camera.world_to_cam.clone()
    world_to_cam[:3, 3] *= factor
    return Camera(world_to_cam, camera.intrinsics, camera.height, camera.width)


PLANE = Scene((plane(0.0),))
SPHERE = Scene((sphere(0.8),))
SPHERE_ON_PLANE = Scene((sphere(0.6), plane(0.6, (0.0, 1.0, 0.0)), plane(2.0)))
CARD_AND_PLANE = Scene((box((-0.5, -0.5, -0.02), (0.5, 0.5, 0.02)), plane(1.2)))
BOX_AND_PLANE = Scene((box((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5)), plane(0.8)))
