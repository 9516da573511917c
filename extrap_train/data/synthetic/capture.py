"""Hand-held walks around synthetic scenes, and captures that are rendered when a frame is read."""

import zlib
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float

from extrap_train.config import SyntheticConfig
from extrap_train.data.sequences import Frame, FrameSequence
from extrap_train.data.synthetic.categories import build_scene
from extrap_train.data.synthetic.parts import SyntheticScene
from extrap_train.data.synthetic.render import render
from extrap_train.geometry.viewpoints import looking_at
from extrap_train.views import Camera, View, WholePhotograph


def sequence_name(index: int) -> str:
    """The name of a category's sequence with this number."""
    return f"{index:04d}"


def walk_seed(category: str, index: int, seed: int) -> int:
    """The seed of the walk around a sequence's scene."""
    return zlib.crc32(f"{seed}/{category}/{index}".encode())


def synthetic_sequence(category: str, index: int, options: SyntheticConfig) -> FrameSequence:
    """The walk around a scene that `data=synthetic` trains on or tests with, not yet rendered.

    Sequences 0 … `test_sequences` − 1 are for testing. Pictures are those on disk before their
    compression. Raises InputError for an unknown category.
    """
    scene = build_scene(category, index, options.seed)
    seed = walk_seed(category, index, options.seed)
    cameras = handheld_orbit(scene, options.frames, options.image_size, seed)
    frames = []
    for number in range(options.frames):
        name, camera = f"frame{number:06d}", cameras[number]
        whole = WholePhotograph(f"{category}/{sequence_name(index)}/{name}", camera)
        load = _Renderer(scene, whole, name).load
        frames.append(Frame(name, camera, True, True, load, (), path=whole.path))
    return FrameSequence(category, sequence_name(index), tuple(frames), poses="the renderer")


@dataclass(frozen=True)
class _Renderer:
    scene: SyntheticScene
    photograph: WholePhotograph
    name: str

    def load(self, *, depth: bool = True) -> View:
        view = render(self.scene, self.photograph.camera)
        view = replace(view, name=self.name, photograph=self.photograph)
        return view if depth else replace(view, depth=None)


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
    position = scene.look_at + distance[:, None] * out
    world_to_cam = _rolls(roll) @ looking_at(position, target, np.array([0.0, 0.0, 1.0]))
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


def _rolls(angles_rad: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 4 4"]:
    """Turns of cameras about their optical axes."""
    turns = np.tile(np.eye(4), (len(angles_rad), 1, 1))
    cos, sin = np.cos(angles_rad), np.sin(angles_rad)
    turns[:, 0, 0], turns[:, 0, 1], turns[:, 1, 0], turns[:, 1, 1] = cos, sin, -sin, cos
    return turns
