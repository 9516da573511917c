"""What the page works on: one opened scene, views of it, and its result; nothing of the page."""

import io
import math
import shlex
import zipfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np
import roma
import torch
from hydra.core.hydra_config import HydraConfig
from jaxtyping import Float

from extrap_train.config import DatasetDepthConfig, StereoConfig, TrainConfig
from extrap_train.data.sequences import FrameSequence
from extrap_train.diffusion.generator import DiffusionGenerator, GeneratedViews
from extrap_train.geometry.cameras import WorldFrame
from extrap_train.geometry.foreign_cameras import rigid_inverse
from extrap_train.reconstruction.completion import map_of_inputs
from extrap_train.reconstruction.global_map import GlobalMap
from extrap_train.reconstruction.inputs import check_cameras, choose_frames, fit_world_frame
from extrap_train.tasks.scene_inputs import open_inputs, open_sequence
from extrap_train.tasks.scene_model import generate_views
from extrap_train.views import Camera, View, stack_cameras, stack_poses

USUAL_INPUTS = 8
"""Photographs that a scene is opened with, unless `inputs` says otherwise."""
_FILES = ("cloud.ply", "mesh.ply", "splats.ply", "turntable.mp4", "growth.png", "summary.json")
_STATE = "map"
"""Folder from which a completion resumes: it repeats what is in the others."""


class Visitor(Protocol):
    """Where a visitor of the page stands: viser's camera, whose axes are ours."""

    wxyz: Float[np.ndarray, "4"]
    position: Float[np.ndarray, "3"]
    fov: float
    """Vertical, in radians."""
    aspect: float


@dataclass(frozen=True)
class StudioScene:
    """A scene with the photographs that views are generated from; the page shows `world`."""

    config: TrainConfig
    """As for `task=complete` of the scene, with the number of inputs."""
    sequence: FrameSequence
    views: list[View]
    """The inputs, with depth, in the photographs' world."""
    world: WorldFrame
    """The frame that the completion of these inputs has, too."""

    def known(self) -> GlobalMap:
        """The inputs as the page draws them."""
        inside = [self.world.view_inside(view) for view in self.views]
        certain = [(view.depth > 0).float() for view in inside if view.depth is not None]
        return map_of_inputs(inside, certain, self.config.complete.tolerance)

    def others(self) -> dict[str, Camera]:
        """Cameras of the photographs that are no inputs, in the page's frame, by their names."""
        used = {view.name for view in self.views}
        frames = (frame for frame in self.sequence.frames if frame.name not in used)
        return {frame.name: self.world.inside(frame.camera) for frame in frames}

    def camera(self, name: str) -> Camera:
        """Where the photograph of this name was taken, in the page's frame."""
        found = next(frame for frame in self.sequence.frames if frame.name == name)
        return self.world.inside(found.camera)

    def view_from(self, camera: Camera, generator: DiffusionGenerator) -> GeneratedViews:
        """One view from a camera in the page's frame."""
        query = stack_cameras([self.world.outside(camera)])
        return generate_views(generator, self.views, query, ["studio"], self.config)

    def command(self) -> str:
        """The command that completes the scene in the same way."""
        config = self.config
        words = ["task=complete", f"category={config.category.name}", f"scene={config.scene}"]
        words.append(f"depth={config.depth.name}")
        if config.inputs is not None:
            words.append(f"inputs={config.inputs}")
        return f"python -m extrap_train {shlex.join([*words, *_other_words()])}"


def _other_words() -> list[str]:
    """What the studio's own command line says beside what the page chooses."""
    given = HydraConfig.get().overrides.task if HydraConfig.initialized() else []
    chosen = ("task=", "category=", "scene=", "depth=", "inputs=", "studio.")
    return [word for word in given if not word.startswith(chosen)]


def open_studio_scene(config: TrainConfig, size: int) -> StudioScene:
    """The scene, its cameras estimated if need be, and the inputs' depth at `size` pixels.

    The inputs are those of `task=complete`. Raises InputError as that does.
    """
    sequence = open_sequence(config)
    count = min(config.inputs or USUAL_INPUTS, len(sequence.frames))
    config = replace(config, task="complete", inputs=None if config.input_frames else count)
    chosen = choose_frames(
        sequence.frames, config.inputs, config.input_frames, config.complete.draw, config.seed
    )
    frames = [sequence.frames[index] for index in chosen]
    check_cameras([frame.camera for frame in frames], [frame.name for frame in frames])
    named = replace(config, inputs=None, input_frames=[frame.name for frame in frames])
    views = open_inputs(named, sequence, size).views
    cameras = [frame.camera for frame in frames if frame.name in {view.name for view in views}]
    return StudioScene(config, sequence, views, fit_world_frame(stack_poses(cameras)))


def of_photographs(config: TrainConfig, folder: Path) -> TrainConfig:
    """The options for a folder of photographs, whose depth nothing but their pixels says."""
    brought = isinstance(config.depth, DatasetDepthConfig)
    depth = StereoConfig() if brought else config.depth
    return replace(config, scene=str(folder), input_frames=[], depth=depth)


def camera_of(visitor: Visitor, size: int) -> Camera:
    """The largest square in the middle of what a visitor sees, `size` pixels a side."""
    rotation = roma.unitquat_to_rotmat(roma.quat_wxyz_to_xyzw(torch.from_numpy(visitor.wxyz)))
    cam_to_world = torch.eye(4, dtype=torch.float64)
    cam_to_world[:3, :3], cam_to_world[:3, 3] = rotation, torch.from_numpy(visitor.position)
    focal = size / 2 / (math.tan(visitor.fov / 2) * min(1, visitor.aspect))
    half = size / 2
    intrinsics = torch.tensor([[focal, 0, half], [0, focal, half], [0, 0, 1]])
    return Camera(rigid_inverse(cam_to_world).float(), intrinsics, size, size)


def result_files(folder: Path) -> list[str]:
    """Names of a result's files that are offered one by one."""
    return [name for name in _FILES if (folder / name).is_file()]


def zipped(folder: Path) -> bytes:
    """A result as a ZIP, without what only resuming needs; links are left out."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in sorted(folder.rglob("*")):
            inside = path.relative_to(folder)
            hidden = any(part.startswith(".") for part in inside.parts)
            linked = any((folder / part).is_symlink() for part in (inside, *inside.parents[:-1]))
            if path.is_file() and not hidden and not linked and inside.parts[0] != _STATE:
                archive.write(path, Path(folder.name) / inside)
    return content.getvalue()
