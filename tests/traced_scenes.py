"""Ray-traced scenes with a solid texture and exact depth."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from extrap_train.geometry.cameras import pixel_grid
from extrap_train.views import Camera, View

Surface = Callable[[Tensor, Tensor], Tensor]
"""(origin, directions) → ray parameter of the first hit, infinite without one."""


def sphere(center: tuple[float, float, float], radius: float) -> Surface:
    def hit(origin: Tensor, directions: Tensor) -> Tensor:
        offset = origin - torch.tensor(center, dtype=torch.float64)
        a, b = directions.square().sum(-1), directions @ offset
        root = b.square() - a * (offset.square().sum() - radius**2)
        t = (-b - root.clamp_min(0).sqrt()) / a
        return torch.where((root > 0) & (t > 0), t, torch.inf)

    return hit


def plane(normal: tuple[float, float, float], offset: float) -> Surface:
    n = torch.tensor(normal, dtype=torch.float64)

    def hit(origin: Tensor, directions: Tensor) -> Tensor:
        t = (offset - n @ origin) / (directions @ n)
        return torch.where(t > 0, t, torch.inf)

    return hit


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> Surface:
    corners = torch.tensor([low, high], dtype=torch.float64)

    def hit(origin: Tensor, directions: Tensor) -> Tensor:
        ts = (corners[:, None, None] - origin) / directions
        enter, leave = ts.amin(0).amax(-1), ts.amax(0).amin(-1)
        return torch.where((enter < leave) & (enter > 0), enter, torch.inf)

    return hit


SCENES: dict[str, list[Surface]] = {
    "sphere on the ground": [sphere((0, 0, 0), 0.5), plane((0, 1, 0), 0.5), plane((0, 0, 1), 4.0)],
    "box on the ground": [
        box((-0.4, -0.3, -0.35), (0.4, 0.5, 0.35)),
        plane((0, 1, 0), 0.5),
        plane((0, 0, 1), 4.0),
    ],
    "slanted plane": [plane((0.3, 0.5, 0.8), 0.1)],
}


def orbit_camera(azimuth_deg: float, size: int, distance: float = 2.2) -> Camera:
    """A camera that looks at the origin from 25° above (+Y is down)."""
    azimuth, elevation = math.radians(azimuth_deg), math.radians(25)
    center = distance * torch.tensor(
        [
            math.cos(elevation) * math.sin(azimuth),
            -math.sin(elevation),
            -math.cos(elevation) * math.cos(azimuth),
        ]
    )
    forward = -center / center.norm()
    right = torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0]), forward)
    right = right / right.norm()
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    world_to_cam = torch.eye(4)
    world_to_cam[:3, :3], world_to_cam[:3, 3] = rotation, -rotation @ center
    intrinsics = torch.tensor([[1.2 * size, 0, size / 2], [0, 1.2 * size, size / 2], [0, 0, 1]])
    return Camera(world_to_cam, intrinsics, size, size)


def render(scene: list[Surface], camera: Camera, gain: float = 1.0, noise: float = 0.0) -> View:
    """The scene as a photograph with its exact depth."""
    grid = pixel_grid(camera.height, camera.width).double()
    k, cam_to_world = camera.intrinsics.double(), camera.cam_to_world.double()
    rays = torch.stack(
        [
            (grid[..., 0] - k[0, 2]) / k[0, 0],
            (grid[..., 1] - k[1, 2]) / k[1, 1],
            torch.ones(camera.height, camera.width, dtype=torch.float64),
        ],
        -1,
    )
    directions, origin = rays @ cam_to_world[:3, :3].T, cam_to_world[:3, 3]
    depth = torch.stack([surface(origin, directions) for surface in scene]).amin(0)
    points = origin + depth[..., None] * directions
    image = _texture(points).permute(2, 0, 1) * gain
    image = image + noise * torch.randn(image.shape, generator=torch.Generator().manual_seed(0))
    return View(image.clamp(0, 1).float(), camera, depth.float())


def _texture(points: Tensor) -> Tensor:
    """Band-limited noise: a sum of waves of many directions and lengths."""
    generator = torch.Generator().manual_seed(7)
    directions = torch.randn(3, 40, 3, generator=generator, dtype=torch.float64)
    directions = directions / directions.norm(dim=-1, keepdim=True)
    lengths = 0.05 * 10 ** torch.rand(3, 40, 1, generator=generator, dtype=torch.float64)
    phases = 2 * math.pi * torch.rand(3, 40, generator=generator, dtype=torch.float64)
    waves = torch.einsum("hwi,cki->hwck", points, directions * (2 * math.pi / lengths))
    return 0.5 + 0.05 * torch.sin(waves + phases).sum(-1)
