"""From photographs to the map's first views: which, in which unit, and whether they will do."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from extrap_train.data.sequences import Frame
from extrap_train.depth import RELIABLE_CONFIDENCE, DepthSource
from extrap_train.errors import InputError, did_you_mean
from extrap_train.geometry.cameras import WorldFrame
from extrap_train.geometry.viewpoints import (
    camera_centers,
    facing,
    farthest_point_sample,
    fit_orbit_of_few,
    pairwise_angles,
    scene_center,
)
from extrap_train.reconstruction.continuation import continued_depth
from extrap_train.reconstruction.new_view import CONTINUED_CONFIDENCE
from extrap_train.views import Camera, View, stack_poses

ONE_SIDED_STEP_RAD = np.radians(25)
"""Wanted between neighbouring inputs that stand on one side."""
SAME_POSE_RAD = np.radians(0.5)
LOOKS_AT_RAD = np.radians(45)
WORKING_SIDE = 512
"""Photographs are not looked at more closely than this many pixels a side."""


def fit_world_frame(cameras: Camera) -> WorldFrame:
    """The map's world: the inputs' cameras, which look at something in common, stand about 1 away
    from its origin."""
    center = scene_center(cameras)
    distance = np.median(np.linalg.norm(camera_centers(cameras) - center, axis=1))
    return WorldFrame(torch.from_numpy(center), float(distance))


def choose_frames(
    frames: Sequence[Frame], count: int | None, names: Sequence[str], draw: str, seed: int
) -> list[int]:
    """Indices of the photographs that `task=complete` starts from; InputError for names that there
    are not, or where there are fewer than `count`.

    They are in the order of the walk, or as they are named: the map grows from the first on. Other
    tasks choose with `data.square_frames.select_input_frames`.
    `one_sided` walks along the orbit in steps near 25°, with no gap of 60° where that can be;
    `spread` takes the farthest cameras.
    """
    if names:
        places = {frame.name: index for index, frame in enumerate(frames)}
        if missing := [name for name in names if name not in places]:
            near = did_you_mean(missing[0], places)
            raise InputError(f"input_frames: the scene has no frame {missing[0]}; {near}")
        return [places[name] for name in names]
    if count is not None and count > len(frames):
        raise InputError(f"inputs={count}: the scene has {len(frames)} frames; give fewer")
    if count is None or count == len(frames):
        return list(range(len(frames)))
    cameras = stack_poses([frame.camera for frame in frames])
    start = int(np.random.default_rng(seed).integers(len(frames)))
    if draw == "spread":
        chosen = farthest_point_sample(camera_centers(cameras), count, start)
        return sorted(int(index) for index in chosen)
    azimuths, _, _ = fit_orbit_of_few(cameras).locate(camera_centers(cameras))
    walks: dict[float, list[int]] = {}
    for first in (start, *np.argsort(azimuths)):
        walk = [int(first)]
        while len(walk) < count:
            ahead = (azimuths - azimuths[walk[-1]]) % (2 * np.pi)
            ahead[walk] = np.inf
            walk.append(int(np.abs(ahead - ONE_SIDED_STEP_RAD).argmin()))
        largest_gap = float((np.diff(azimuths[walk]) % (2 * np.pi)).max(initial=0.0))
        if largest_gap < np.pi / 3:
            return walk
        walks.setdefault(largest_gap, walk)
    return walks[min(walks)]


def check_cameras(cameras: Sequence[Camera], names: Sequence[str]) -> None:
    """Refuse, in one line, what no scene can be completed from."""
    if len(cameras) < 2:
        raise InputError(
            "one photograph does not show where its surfaces are; give at least two (inputs=3)"
        )
    poses = stack_poses(list(cameras))
    center = scene_center(poses)
    seen = facing(poses, center, LOOKS_AT_RAD)
    if not seen.all():
        strays = np.array(names)[~seen]
        more = f" and {len(strays) - 3} more" if len(strays) > 3 else ""
        look, them = ("looks", "it") if len(strays) == 1 else ("look", "them")
        raise InputError(
            f"{', '.join(strays[:3])}{more}: {look} away from what the other photographs look at, "
            "so that they see nothing in common; check the poses (their axes: +X right, +Y down, "
            f"+Z forward after reading) or leave {them} out"
        )
    angles = pairwise_angles(poses, center)
    apart = np.linalg.norm(np.diff(camera_centers(poses), axis=0), axis=1).max()
    np.fill_diagonal(angles, np.inf)
    one, other = divmod(int(angles.argmin()), len(names))
    if angles.min() < SAME_POSE_RAD or apart == 0:
        raise InputError(
            f"{names[one]} and {names[other]} stand in the same place as seen from the scene; "
            "leave one out or correct the poses"
        )


def stand_where(
    camera: Camera, others: Camera, center: Float[np.ndarray, "3"]
) -> Bool[np.ndarray, " n"]:
    """Which of the others stand where an (unbatched) camera does, as seen from the scene."""
    poses = [camera, *(others[i] for i in range(len(others.world_to_cam)))]
    return pairwise_angles(stack_poses(poses), center)[0, 1:] < SAME_POSE_RAD


def first_views(
    photographs: Sequence[View], source: DepthSource, world: WorldFrame, size: int
) -> tuple[list[View], list[Float[Tensor, "s s"]]]:
    """The photographs as squares of `size` pixels in the map's world, with depth and confidence.

    Depth is measured on larger squares; where it is not reliable, surfaces are continued, with low
    confidence. InputError where no photograph has any reliable depth.
    """
    side = max(size, source.image_size or WORKING_SIDE)
    squares = [
        photo.squared(min(side, photo.camera.height, photo.camera.width)) for photo in photographs
    ]
    scaled = [world.view_inside(view) for view in squares]
    views, confidences = [], []
    for view, found in zip(scaled, source.depth_maps(scaled), strict=True):
        reliable = found.reliable()
        small = replace(view, depth=reliable).resized(size, size)
        assert small.depth is not None
        confidence = functional.interpolate(
            found.confidence.clamp(max=1)[None, None], (size, size), mode="nearest-exact"
        )[0, 0]
        whole = continued_depth(small.depth, small.image)
        confidence = torch.where(small.depth > 0, confidence, CONTINUED_CONFIDENCE)
        image = (small.image * 255).round() / 255
        views.append(replace(small, image=image, depth=whole, mask=None))
        confidences.append(torch.where(whole > 0, confidence, 0))
    if not any((c >= RELIABLE_CONFIDENCE).any() for c in confidences):
        raise InputError(
            "no reliable depth in any photograph; stereo needs photographs 3° to 45° apart "
            "(complete.draw=one_sided) that show the same textured surfaces"
        )
    return views, confidences
