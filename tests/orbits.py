"""Cameras on orbits and captures made of them, in memory."""

from collections.abc import Callable, Collection
from dataclasses import dataclass

import numpy as np
import torch
from scenes import SPHERE_ON_PLANE, orbit_camera
from torch.nn import functional

from extrap_train.data.sequences import Frame, FrameSequence
from extrap_train.errors import InputError
from extrap_train.geometry.cameras import unproject_to_world
from extrap_train.views import Camera, View, stack_cameras


def looking_at(
    positions: np.ndarray, target: np.ndarray, height: int = 48, width: int = 64
) -> Camera:
    """Cameras whose optical axes meet in `target`, image-up towards +z."""
    forward = target - positions
    forward = forward / np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    rotation = np.stack([right, np.cross(forward, right), forward], 1)
    world_to_cam = np.tile(np.eye(4), (len(positions), 1, 1))
    world_to_cam[:, :3, :3] = rotation
    world_to_cam[:, :3, 3] = -np.einsum("nij,nj->ni", rotation, positions)
    intrinsics = np.tile(np.diag([60.0, 60.0, 1.0]), (len(positions), 1, 1))
    intrinsics[:, :2, 2] = width / 2, height / 2
    return Camera(
        torch.tensor(world_to_cam).float(), torch.tensor(intrinsics).float(), height, width
    )


def ring(
    azimuths_deg: np.ndarray,
    elevation_deg: float = 20.0,
    radius: float | np.ndarray = 3.0,
    center: tuple[float, float, float] = (0.5, -0.2, 0.1),
) -> Camera:
    """Cameras around +z at azimuths of one's choice."""
    azimuth, elevation = np.radians(azimuths_deg), np.radians(elevation_deg)
    level = np.stack([np.cos(azimuth), np.sin(azimuth)], 1) * np.cos(elevation)
    directions = np.concatenate([level, np.full((len(level), 1), np.sin(elevation))], 1)
    radii = np.broadcast_to(radius, len(level))[:, None]
    return looking_at(directions * radii + np.array(center), np.array(center))


def even(count: int, span_deg: float = 360.0) -> np.ndarray:
    """Azimuths in equal steps."""
    return np.arange(count) * span_deg / count


def walls(count: int) -> list[View]:
    """Views of 64² with depth: walls of smooth noise seen from an arc, 25 degrees apart."""
    cameras = ring(np.arange(count) * 25.0).squared(64)
    images = torch.rand(count, 3, 8, 8, generator=torch.Generator().manual_seed(0))
    smooth = functional.interpolate(images, size=(64, 64), mode="bilinear")
    depth = torch.full((64, 64), 3.0)
    return [View(smooth[i], cameras[i], depth, name=f"v{i}") for i in range(count)]


def capture(
    camera: Camera,
    name: str = "one",
    depth: float = 3.0,
    mask: Callable[[int], torch.Tensor | None] = lambda index: None,
    broken: Collection[int] = (),
    **quality: float,
) -> FrameSequence:
    """A capture whose frame `i` is all of the grey `i / n`, at one depth."""
    count = len(camera.world_to_cam)

    def load(index: int, depth_too: bool) -> View:
        if index in broken:
            raise InputError(f"{name}/frame{index}.jpg: truncated; restore it")
        size = (camera.height, camera.width)
        grey, flat = torch.full((3, *size), index / count), torch.full(size, depth)
        far = flat if depth_too else None
        return View(grey, camera[index], far, mask(index), f"frame{index}")

    frames = tuple(
        Frame(
            f"frame{i}",
            camera[i],
            True,
            mask(i) is not None,
            lambda *, depth=True, i=i: load(i, depth),
            (),
        )
        for i in range(count)
    )
    return FrameSequence("cup", name, frames, **quality)


@dataclass(frozen=True)
class _Textured:
    """Loads a frame of a textured sphere before a wall; a dataclass, so that it can be pickled."""

    camera: Camera
    name: str
    depth_factor: float
    broken: bool

    def load(self, *, depth: bool = True) -> View:
        if self.broken:
            raise InputError(f"{self.name}.jpg: truncated; restore it")
        exact = SPHERE_ON_PLANE.depth(self.camera)
        world = unproject_to_world(exact[None], stack_cameras([self.camera]))[0]
        waves = 9 * torch.randn(3, 40, generator=torch.Generator().manual_seed(5))
        fine = torch.sin(world @ waves + torch.arange(40.0)).unflatten(-1, (4, 10)).mean(-1)
        image = SPHERE_ON_PLANE.image(self.camera) + 0.8 * fine[..., :3].permute(2, 0, 1)
        far = (exact * self.depth_factor).clamp(max=50) if depth else None
        return View(image.clamp(0, 1), self.camera, far, None, self.name)


def textured_capture(
    name: str,
    count: int = 12,
    size: int = 64,
    depth_factor: float = 1.04,
    broken: Collection[int] = (),
) -> FrameSequence:
    """A full circle around a textured sphere, whose depths are all too large by a factor."""
    cameras = [orbit_camera(360 * i / count, size=size) for i in range(count)]
    frames = tuple(
        Frame(
            f"frame{i}",
            camera,
            True,
            False,
            _Textured(camera, f"frame{i}", depth_factor, i in broken).load,
            (),
        )
        for i, camera in enumerate(cameras)
    )
    return FrameSequence("cup", name, frames)
