"""What a Gaussian method may know of a scene: the inputs, in the frame it fits in."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from extrap_train.depth import DepthMap, DepthSource
from extrap_train.errors import InputError
from extrap_train.gaussians.frame import SceneFrame, scene_frame
from extrap_train.views import View

_OVERSHOOT = 0.1
"""How far interpolation may take colours out of [0, 1]."""


@dataclass(frozen=True)
class TrainingScene:
    """The input views twice: as they were given, for depth sources, and in the frame."""

    given: tuple[View, ...]
    views: tuple[View, ...]
    frame: SceneFrame
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
    moved = tuple(frame.view(view) for view in views)
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
