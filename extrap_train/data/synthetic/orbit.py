"""Hand-held walks around an object."""

import zlib

import numpy as np
import torch
from jaxtyping import Float

from extrap_train.data.synthetic.scene import SyntheticScene
from extrap_train.views import Camera


def sequence_name(index: int) -> str:
    """The name of a category's sequence with this number."""
    return f"{index:04d}"


def walk_seed(category: str, index: int, seed: int) -> int:
    """The seed of the walk around a sequence's scene."""
    return zlib.crc32(f"{seed}/{category}/{index}".encode())


def handheld_orbit(scene: SyntheticScene, frames: int, image_size: int, seed: int) -> Camera:
    """A full turn around the object with a person's unsteadiness: `frames` square cameras.

    The ball around the object stays in frame, and its height takes about 45–70 % of it.
    """
    rng = np.random.default_rng(seed)
    field_of_view = np.deg2rad(rng.uniform(44, 52))
    steps = np.arange(frames) / frames
    azimuth = 2 * np.pi * (steps + rng.uniform()) * rng.choice([-1, 1])
    azimuth = azimuth + rng.normal(0, 0.15, frames).clip(-0.3, 0.3) * 2 * np.pi / frames
    wave = _slow_wave(rng, steps)
    elevation = np.deg2rad(np.clip(rng.uniform(30, 44) + 6 * wave, 22, 50))
    fill = rng.uniform(0.68, 0.84) * (1 + 0.06 * _slow_wave(rng, steps))
    distance = scene.radius / np.sin(np.arctan(np.tan(field_of_view / 2) * fill))
    out = np.stack(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ],
        -1,
    )
    target = scene.look_at + rng.normal(0, 0.03, (frames, 3)).clip(-0.06, 0.06) * scene.radius
    roll = np.deg2rad(rng.normal(0, 1.5, frames).clip(-4, 4))
    world_to_cam = np.stack(
        [
            _look_at(scene.look_at + d * o, t, r)
            for d, o, t, r in zip(distance, out, target, roll, strict=True)
        ]
    )
    focal = image_size / 2 / np.tan(field_of_view / 2)
    intrinsics = np.array([[focal, 0, image_size / 2], [0, focal, image_size / 2], [0, 0, 1]])
    return Camera(
        torch.from_numpy(world_to_cam).float(),
        torch.from_numpy(intrinsics).float().expand(frames, 3, 3).clone(),
        image_size,
        image_size,
    )


def _slow_wave(rng: np.random.Generator, steps: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """A smooth periodic curve within ±1."""
    phases = rng.uniform(0, 2 * np.pi, 2)
    return 0.65 * np.sin(2 * np.pi * steps + phases[0]) + 0.35 * np.sin(
        4 * np.pi * steps + phases[1]
    )


def _look_at(
    position: Float[np.ndarray, " 3"], target: Float[np.ndarray, " 3"], roll_rad: float
) -> Float[np.ndarray, "4 4"]:
    """world_to_cam of a camera whose image has the world's +Z up, turned by `roll_rad`."""
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    cos, sin = np.cos(roll_rad), np.sin(roll_rad)
    rotation = np.stack([cos * right + sin * down, cos * down - sin * right, forward])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, -rotation @ position
    return matrix
