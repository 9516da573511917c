"""What the tasks about one scene start from: its views with depth, and its other frames."""

from dataclasses import dataclass, replace

from extrap_train.config import SyntheticConfig, TrainConfig
from extrap_train.data.photographs import CATEGORY
from extrap_train.data.scene import open_scene
from extrap_train.data.scene_views import input_views, select_input_frames
from extrap_train.data.sequences import Frame, FrameSequence
from extrap_train.depth.sources import depth_source
from extrap_train.errors import InputError
from extrap_train.views import View


@dataclass(frozen=True)
class SceneInputs:
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


def open_sequence(config: TrainConfig) -> FrameSequence:
    """The scene's frames, of which no photograph has been read yet."""
    synthetic = config.data if isinstance(config.data, SyntheticConfig) else None
    return open_scene(required_scene(config), synthetic)


def label_of(sequence: FrameSequence) -> str:
    """The scene's name in a path."""
    if sequence.category == CATEGORY:
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
            f"scene {config.scene}: {query} is its only frame, and is asked for; give more"
        )
    return part, select_input_frames(part, config.input_frames, config.inputs)


def open_inputs(
    config: TrainConfig, sequence: FrameSequence, image_size: int, query: str | None = None
) -> SceneInputs:
    """The scene's input views at this size; depth comes from these views alone.

    The frame called `query` is none of them, so that it can be compared with, unless
    `input_frames` names it.
    """
    part, chosen = input_frames(config, sequence, query)
    views = input_views(part, chosen, depth_source(config.depth), image_size)
    names = {view.name for view in views}
    others = [frame for frame in sequence.frames if frame.name not in names]
    return SceneInputs(views, others)
