"""The input views in the normalised world that Gaussians are fitted in.

There published thresholds mean something.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch

from extrap_train.depth import DepthMap, DepthSource
from extrap_train.depth.neighbours import convergence_point
from extrap_train.errors import InputError
from extrap_train.geometry.cameras import WorldFrame
from extrap_train.views import Camera, View

_SAME_PLACE = 1e-6
"""Cameras nearer to each other than this share of their distance from the origin coincide."""


def scene_frame(cameras: Sequence[Camera]) -> WorldFrame:
    """The frame that the input cameras alone define, with the scene's extent as its unit.

    The extent (3DGS: the radius of the cameras) is the mean distance of the cameras to what they
    look at: with three views the cameras' own spread says little of the scene's size.

    Centre: the point nearest to their optical axes. Cameras that look the same way have none:
    there the centre is their mean position and the unit the largest distance from it. InputError
    if all cameras stand at one place.
    """
    positions = torch.stack([camera.center for camera in cameras])
    mean = positions.mean(0)
    spread = float((positions - mean).norm(dim=-1).max())
    if spread <= _SAME_PLACE * float(positions.abs().max().clamp_min(1e-30)):
        raise InputError("all input views stand at one place; Gaussians need views from two")
    center = convergence_point(list(cameras))
    if center is None:
        return WorldFrame(mean, spread)
    return WorldFrame(center, float((positions - center).norm(dim=-1).mean()))


_OVERSHOOT = 0.1
"""How far interpolation may take colours out of [0, 1]."""


@dataclass(frozen=True)
class TrainingScene:
    """The input views twice: as they were given, for depth sources, and in the frame."""

    given: tuple[View, ...]
    views: tuple[View, ...]
    frame: WorldFrame
    depth_source: DepthSource
    seed: int
    record: dict[str, str] = field(default_factory=dict)
    """What was used and what happened, in words: ends up beside the result."""

    def depth_maps(self, source: DepthSource) -> list[DepthMap]:
        """Depth of every view by a source that knows the world's unit, in the frame's."""
        maps = source.depth_maps(self.given)
        return [replace(each, depth=each.depth / self.frame.unit) for each in maps]


def training_scene(views: Sequence[View], depth_source: DepthSource, seed: int) -> TrainingScene:
    """The scene of these views; InputError for fewer than two, or one that cannot be used."""
    if len(views) < 2:
        raise InputError(f"{len(views)} input view(s): Gaussians need at least two; give more")
    for index, view in enumerate(views):
        trouble = _trouble(view)
        if trouble is not None:
            name = view.name or f"input view {index}"
            raise InputError(f"{name}: {trouble}; mend the input")
    frame = scene_frame([view.camera for view in views])
    moved = tuple(frame.view_inside(view) for view in views)
    return TrainingScene(tuple(views), moved, frame, depth_source, seed)


def _trouble(view: View) -> str | None:
    """Why a posed photograph cannot be used."""
    image, camera = view.image, view.camera
    finite = camera.world_to_cam.isfinite().all() and camera.intrinsics.isfinite().all()
    if not (finite and image.isfinite().all()):
        return "its image, pose or intrinsics are not finite"
    height, width = image.shape[-2:]
    if (height, width) != (camera.height, camera.width):
        return f"its image is {width}x{height}, its camera's {camera.width}x{camera.height}"
    if not (camera.intrinsics.diagonal()[:2] > 0).all():
        return "its focal length is not positive"
    low, high = float(image.min()), float(image.max())
    if low < -_OVERSHOOT or high > 1 + _OVERSHOOT:
        return f"its colours run from {low:g} to {high:g}, and not from 0 to 1"
    return None
