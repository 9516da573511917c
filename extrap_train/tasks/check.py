"""`task=check`: one picture that proves a scene's poses, scale, lens and masks, or shows faults."""

import math

from extrap_train.config import TrainConfig
from extrap_train.data.square_frames import load_readable, select_input_frames
from extrap_train.errors import InputError
from extrap_train.reconstruction.capture_check import check_capture
from extrap_train.reconstruction.check_picture import draw_check
from extrap_train.store.manifest import claim
from extrap_train.tasks.scene_inputs import (
    label_of,
    nothing_kept,
    open_sequence,
    result_folder,
    scene_manifest,
)
from extrap_train.terminal import terminal

MAX_VIEWS = 24
"""Checked unless `inputs` or `input_frames` say otherwise."""
MIN_VIEWS = 3


def run(config: TrainConfig) -> None:
    """Draw `check.png`, replacing an earlier one, and print one line for each thing found."""
    with nothing_kept():
        _check(config)


def _check(config: TrainConfig) -> None:
    sequence = open_sequence(config, with_depth=False)
    count = config.inputs or min(len(sequence.frames), MAX_VIEWS)
    chosen = select_input_frames(sequence, config.input_frames, count)
    frames = [sequence.frames[index] for index in chosen]
    unreadable: list[str] = []
    views = list(load_readable(frames, unreadable, depth=True))
    if len(views) < MIN_VIEWS:
        why = f"; {unreadable[0]}" if unreadable else ""
        raise InputError(
            f"scene {config.scene}: has {len(views)} readable views, and a check takes at least "
            f"{MIN_VIEWS}{why}"
        )
    check = check_capture(views)
    check.problems.extend(unreadable)
    folder, console = result_folder(config, label_of(sequence)), terminal()
    manifest = scene_manifest(config, frames, {}, {})
    with claim(folder, manifest, resume=False) as result, result.replace() as whole:
        draw_check(check, whole / "check.png")
    distance, reprojection = (
        f"{pixels:.2f} px" if math.isfinite(pixels) else "an unknown distance"
        for pixels in check.residuals
    )
    console.print(f"poses: {sequence.poses or 'the data set'}")
    console.print(
        f"median residuals: matches lie {distance} from their epipolar lines, points of two views "
        f"{reprojection} from where a third has them"
    )
    for problem in check.problems:
        console.print(problem)
    if not check.problems:
        console.print(f"nothing looks wrong in {len(views)} of {len(sequence.frames)} views")
    if not any(view.mask is not None for view in views):
        console.print("no masks: the whole picture counts as the object's")
    console.print(f"result: {folder / 'check.png'}")
