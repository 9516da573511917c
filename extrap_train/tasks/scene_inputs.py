"""What the tasks about one scene start from: its views, their digests, and the result's folder."""

import hashlib
import json
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch

from extrap_train.config import (
    DatasetDepthConfig,
    DepthConfig,
    FilesDepthConfig,
    SyntheticConfig,
    TrainConfig,
    dotted,
)
from extrap_train.data.scene_spec import SYNTHETIC_SCHEME, open_scene, scene_address
from extrap_train.data.sequences import NO_CATEGORY, Frame, FrameSequence
from extrap_train.data.square_frames import input_views, select_input_frames
from extrap_train.depth.depth_folder import find_depth_file
from extrap_train.depth.sources import depth_source, weight_files
from extrap_train.errors import InputError
from extrap_train.runs import given_name, short_name
from extrap_train.store.digests import file_digest
from extrap_train.store.manifest import Manifest
from extrap_train.views import View

_MIB = 2**20


@dataclass(frozen=True)
class InputViews:
    """A scene's chosen views with depth, and its frames that are left over."""

    views: list[View]
    """Square, at the size that a model's warps are made at."""
    others: list[Frame]


def required_scene(config: TrainConfig) -> str:
    """The scene's address; raises InputError where none is given."""
    if config.scene is None:
        raise InputError(
            f"task={config.task} needs a scene: give scene=FOLDER, "
            "scene=co3d:ROOT/category/sequence or scene=synthetic:category/0003"
        )
    return config.scene


def open_sequence(config: TrainConfig, *, with_depth: bool = True) -> FrameSequence:
    """The scene's frames, of which no photograph has been read yet.

    Raises InputError, before cameras are estimated, where their depth cannot be had `with_depth`:
    weights that cannot be used, or depth=dataset for photographs that bring none.
    """
    scene = required_scene(config)
    synthetic = config.data if isinstance(config.data, SyntheticConfig) else None
    if with_depth:
        depth_source(config.depth, torch.device("cpu"))
    needs_depth = with_depth and isinstance(config.depth, DatasetDepthConfig)
    return open_scene(scene, synthetic, config.poses, needs_depth=needs_depth)


def label_of(sequence: FrameSequence) -> str:
    """The scene's name in a path."""
    if sequence.category == NO_CATEGORY:
        return sequence.name
    return f"{sequence.category}-{sequence.name}"


def input_frames(
    config: TrainConfig, sequence: FrameSequence, query: str | None = None
) -> tuple[FrameSequence, list[int]]:
    """The frames that inputs are chosen from, and the places of those that are; see `open_inputs`.

    Reads no photograph. Raises InputError where there are too few.
    """
    known = tuple(frame for frame in sequence.frames if frame.name != query)
    part = sequence if config.input_frames else replace(sequence, frames=known)
    if not part.frames:
        raise InputError(
            f"{config.scene}: the scene's only frame, {query}, is the one that pose= asks for; the "
            "scene needs at least one other"
        )
    return part, select_input_frames(part, config.input_frames, config.inputs)


def open_inputs(
    config: TrainConfig, sequence: FrameSequence, image_size: int, query: str | None = None
) -> InputViews:
    """The scene's input views at this size; depth comes from these views alone.

    The frame called `query` is none of them, so that it can be compared with, unless
    `input_frames` names it.
    """
    part, chosen = input_frames(config, sequence, query)
    views = input_views(part, chosen, depth_source(config.depth), image_size)
    names = {view.name for view in views}
    if lost := [name for name in config.input_frames if name not in names]:
        raise InputError(
            f"input_frames: {lost[0]} cannot be used, as the warning says; mend it or name another"
        )
    others = [frame for frame in sequence.frames if frame.name not in names]
    return InputViews(views, others)


def frame_digest(frame: Frame) -> str:
    """SHA-256 of a frame's camera, of how it is read, and of its photograph, mask and depth.

    A frame without files is rendered: that follows from the options and its name.
    """
    camera, rendered = frame.camera, [] if frame.files else [frame.name]
    about = [camera.height, camera.width, frame.reading, *rendered]
    digest = hashlib.sha256(json.dumps(about).encode())
    for tensor in (camera.world_to_cam, camera.intrinsics):
        digest.update(tensor.numpy(force=True).tobytes())
    for file in frame.files:
        digest.update((file_digest(file) if file.exists() else "missing").encode())
    return digest.hexdigest()


def photograph_digests(frames: Iterable[Frame]) -> dict[str, str]:
    """The frames' digests by their names."""
    return {frame.name: frame_digest(frame) for frame in frames}


def scene_manifest(
    config: TrainConfig,
    frames: Iterable[Frame],
    weights: Mapping[str, str],
    options: Mapping[str, Any],
) -> Manifest:
    """What a task's result about a scene is made from.

    `frames` are those that it reads, `weights` digests of the model, `options` the task's own.
    """
    scene = required_scene(config)
    made = isinstance(config.data, SyntheticConfig) and scene.startswith(SYNTHETIC_SCHEME)
    of_capture = ("frames", "image_size", "seed") if made else ()
    common = {
        "scene": scene_address(scene),
        "data": {name: getattr(config.data, name) for name in of_capture},
        "inputs": config.inputs,
        "input_frames": config.input_frames,
        "depth": asdict(config.depth),
        "sampler": asdict(config.sampler),
        "trainer.precision": config.trainer.precision,
        "seed": config.seed,
    }
    frames = list(frames)
    depth_files = _depth_files(config.depth, frames)
    return Manifest.of(
        dotted(common) | dict(options),
        {
            **weights,
            **{f"weights of depth ({name})": file_digest(f) for name, f in depth_files.items()},
            **{f"photograph {name}": d for name, d in photograph_digests(frames).items()},
        },
    )


def _depth_files(depth: DepthConfig, frames: Iterable[Frame]) -> dict[str, Path]:
    """What the depth of these frames is made from: of a folder of depth maps, their own files."""
    if not isinstance(depth, FilesDepthConfig):
        return {file.name: file for file in weight_files(depth) if file.is_file()}
    folder = Path(depth.folder or "")
    maps = [find_depth_file(folder, frame.path) for frame in frames if frame.path]
    found = {file.relative_to(folder).as_posix(): file for file in maps if file}
    matching = weight_files(depth.matcher) if depth.align == "affine" else []
    return found | {file.name: file for file in matching}


def result_folder(config: TrainConfig, label: str) -> Path:
    """Where a task's result about a scene lies: called like the scene, or as `run` says."""
    return Path(config.output) / config.task / (given_name(config) or short_name(label))


@contextmanager
def nothing_kept() -> Iterator[None]:
    """Say on Ctrl-C that the block, whose result appears at its end, leaves nothing."""
    try:
        yield
    except KeyboardInterrupt:
        raise KeyboardInterrupt(
            "nothing was changed; the same command starts from the beginning"
        ) from None


def require_space(folder: Path, needed: int) -> None:
    """InputError if the disk that a folder will lie on has less than `needed` bytes left."""
    place = next(path for path in (folder, *folder.resolve().parents) if path.exists())
    free = shutil.disk_usage(place).free
    if free < needed:
        raise InputError(
            f"{folder}: no space left on the device ({free / _MIB:.1f} MiB free, about "
            f"{needed / _MIB:.1f} MiB needed); free some or choose another output="
        )
