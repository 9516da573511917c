"""Whether a COLMAP model's points lie where its images show them, or would in another convention.

Around the world's origin, cameras whose quaternions are misread still look at it: their poses look
sound together, and only the points tell.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from torch import Tensor

from extrap_train.data.camera_check import COLMAP_POSES, NEARLY_ALL, Reread
from extrap_train.data.colmap_files import read_model_points
from extrap_train.errors import InputError
from extrap_train.geometry.lens import Lens, distort

_MIN_OBSERVATIONS = 20
"""Over all images."""
_MIN_IMAGES = 3
_FAR, _NEAR = 0.05, 0.02
"""Median distance of points from where images show them, as a share of the longer side: poses with
more are wrong if another convention leaves less. COLMAP drops points beyond 4 pixels."""
_FEW, _MANY = 0.1, 0.5
"""Share of the points within the pictures, where no image says which it shows: poses with less are
wrong if in another convention nearly every picture has more."""
_POINTS_COUNTED = 2000

log = logging.getLogger(__name__)


Track = tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 2"]]
"""Points in space and the pixels of one image that show them."""


@dataclass(frozen=True)
class Sighting:
    """What one image of a model shows."""

    world_to_cam: Float[Tensor, "4 4"]
    lens: Lens
    height: int
    width: int
    observed: tuple[tuple[float, float, int], ...]
    """Column, row and number of the point in space, in pixels of the lens."""


def check_points(model: Path, sightings: Sequence[Sighting]) -> None:
    """Raise InputError where the points contradict the poses and another convention explains them.

    Nothing is said of a model without points, nor of one whose points no convention puts right.
    """
    try:
        numbers, points = read_model_points(model)
    except InputError as error:
        log.warning("%s (its poses are not checked against its points)", error)
        return
    tracks = [_track_points(sighting, numbers, points) for sighting in sightings]
    where, belong = f"{model}: its points", f"its poses must be {COLMAP_POSES.name}"
    mistakes = COLMAP_POSES.mistakes
    if sum(len(places) for places, _ in tracks) >= _MIN_OBSERVATIONS:
        given = _misfit(sightings, tracks, _as_read)
        others = {name: _misfit(sightings, tracks, reread) for name, reread in mistakes.items()}
        best = min(others, key=lambda name: others[name])
        if given > _FAR and others[best] < _NEAR:
            far = f"{given:.0%} of a picture's side from where its images show them"
            raise InputError(
                f"{where} lie {far if np.isfinite(given) else 'behind its cameras'}, but "
                f"within {others[best]:.1%} of a side if the poses are read as {best}; {belong}"
            )
    elif len(points) >= _MIN_OBSERVATIONS and len(sightings) >= _MIN_IMAGES:
        some = points[:: -(-len(points) // _POINTS_COUNTED)]
        given = _in_view(sightings, some, _as_read, NEARLY_ALL)
        others = {
            name: _in_view(sightings, some, reread, 1 - NEARLY_ALL)
            for name, reread in mistakes.items()
        }
        best = max(others, key=lambda name: others[name])
        if given < _FEW and others[best] > _MANY:
            raise InputError(
                f"{where} are out of its pictures' sight (they show {given:.0%} at most), but not "
                f"if the poses are read as {best} (then {others[best]:.0%} at least); {belong}"
            )


def _as_read(poses: Float[Tensor, "4 4"]) -> Float[Tensor, "4 4"]:
    return poses


def _track_points(
    sighting: Sighting, numbers: Int[np.ndarray, " m"], points: Float[np.ndarray, "m 3"]
) -> Track:
    """Those of the points that the image says it shows, and its pixels of them."""
    pixels = np.array([seen[:2] for seen in sighting.observed], np.float64).reshape(-1, 2)
    wanted = np.array([seen[2] for seen in sighting.observed], np.int64)
    known = np.isin(wanted, numbers)
    return points[np.searchsorted(numbers, wanted[known])], pixels[known]


def _misfit(sightings: Sequence[Sighting], tracks: Sequence[Track], reread: Reread) -> float:
    """Median distance of points from their pixels, as a share of the longer side."""
    errors = []
    for sighting, (places, pixels) in zip(sightings, tracks, strict=True):
        offset = _project(sighting, places, reread) - pixels
        errors.append(np.hypot(*offset.T) / max(sighting.height, sighting.width))
    return float(np.median(np.nan_to_num(np.concatenate(errors), nan=np.inf, posinf=np.inf)))


def _in_view(
    sightings: Sequence[Sighting], points: Float[np.ndarray, "m 3"], reread: Reread, rank: float
) -> float:
    """Share of the points that a picture shows if nothing hides them, a quantile over pictures."""
    shares = []
    for sighting in sightings:
        pixels = _project(sighting, points, reread)
        inside = (pixels >= 0) & (pixels <= [sighting.width, sighting.height])
        shares.append(inside.all(1).mean())
    return float(np.quantile(shares, rank))


def _project(
    sighting: Sighting, points: Float[np.ndarray, "n 3"], reread: Reread
) -> Float[np.ndarray, "n 2"]:
    """Pixels of points in space; infinite behind the camera."""
    world_to_cam = reread(sighting.world_to_cam).numpy()
    seen = points @ world_to_cam[:3, :3].T + world_to_cam[:3, 3]
    pixels = np.full((len(points), 2), np.inf)
    ahead = seen[:, 2] > 0
    if ahead.any():
        pixels[ahead] = distort(seen[ahead, :2] / seen[ahead, 2:], sighting.lens)
    return pixels
