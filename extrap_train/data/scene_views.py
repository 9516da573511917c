"""A scene's posed views as a model takes them: framed, sized and with depth."""

import logging
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from extrap_train.data.sequences import Frame, FrameSequence
from extrap_train.data.square_frames import load_readable, make_frames, object_square
from extrap_train.depth import DepthSource
from extrap_train.errors import InputError, did_you_mean
from extrap_train.geometry.viewpoints import camera_centers, farthest_point_sample
from extrap_train.views import View, stack_poses

LOG = logging.getLogger(__name__)


def select_input_frames(
    sequence: FrameSequence, names: Sequence[str], count: int | None
) -> list[int]:
    """Indices of a scene's input frames, in their order.

    The frames that are named; else `count` spread by farthest point sampling of the positions; else
    all. Raises InputError where there are fewer.
    """
    known = [frame.name for frame in sequence.frames]
    where = f"scene {sequence.category}/{sequence.name}"
    unknown = [name for name in names if name not in known]
    if unknown:
        raise InputError(f"{where}: has no frame {unknown[0]}; {did_you_mean(unknown[0], known)}")
    if names:
        return sorted({known.index(name) for name in names})
    if count is None:
        return list(range(len(known)))
    if count > len(known):
        raise InputError(f"{where}: has {len(known)} frames, fewer than the {count} asked for")
    cameras = stack_poses([frame.camera for frame in sequence.frames])
    return sorted(farthest_point_sample(camera_centers(cameras), count).tolist())


def input_views(
    sequence: FrameSequence, chosen: Sequence[int], source: DepthSource, size: int
) -> list[View]:
    """The chosen frames as preparation makes them, `size` pixels square, with depth.

    Depth is estimated from these frames alone, so that the others can serve as truth.
    """
    chosen_frames = tuple(sequence.frames[index] for index in chosen)
    part = replace(sequence, frames=chosen_frames, left_out=())
    frames = make_frames(part, source, size, lone=False)
    return [
        View(
            _unit(frames.images[i]).permute(2, 0, 1).contiguous(),
            frames.camera[i],
            torch.from_numpy(frames.depths[i]),
            _unit(frames.masks[i]),
            name,
        )
        for i, name in enumerate(frames.names)
    ]


def target_views(frames: Sequence[Frame], size: int) -> list[View]:
    """Frames framed in the same way, without depth: what a generated view is compared with."""
    return [object_square(view, size) for view in load_held_out(frames)]


def load_held_out(frames: Sequence[Frame]) -> Iterator[View]:
    """The photographs without depth; those that cannot be read are left out with a warning."""
    reasons: list[str] = []
    yield from load_readable(frames, reasons, depth=False)
    if reasons:
        LOG.warning("%d held-out photographs are left out: %s", len(reasons), reasons[0])


def _unit(pixels: UInt8[np.ndarray, "..."]) -> Float[Tensor, "..."]:
    return torch.from_numpy(pixels).float().div_(255)
