"""Where cameras stand around a scene: its centre, their orbit, the angles between them.

Everything here is numpy in float64: a few hundred viewpoints a sequence, and what is decided from
them (filter, pairs, protocol) must not depend on a device. Only poses matter; image sizes and
intrinsics are not looked at.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from extrap_train.views import Camera

LOOKS_AT_RAD = np.deg2rad(60)
"""Largest angle between an optical axis and a point that the camera is said to look at."""
_SAME_PLACE = 1e-9
"""Distances below this share of the scene's extent are zero."""


@dataclass(frozen=True)
class Orbit:
    """Cylinder coordinates of cameras around a scene."""

    axis: Float[np.ndarray, "3"]
    """Unit length; points where the cameras' image-up points on average."""
    center: Float[np.ndarray, "3"]
    azimuths_rad: Float[np.ndarray, " n"]
    """In [0, 2π), from an arbitrary zero; means nothing near the axis."""
    elevations_rad: Float[np.ndarray, " n"]
    """Towards the axis, in [-π/2, π/2]."""


def camera_centers(cameras: Camera) -> Float[np.ndarray, "n 3"]:
    """Positions of the cameras in the world."""
    matrices = cameras.world_to_cam.double().numpy(force=True)
    return -np.einsum("nji,nj->ni", matrices[:, :3, :3], matrices[:, :3, 3])


def scene_center(cameras: Camera) -> Float[np.ndarray, "3"]:
    """The point nearest to all optical axes, by least squares.

    Where the axes leave it open (all parallel), the point nearest to the cameras' mean position;
    check `facing`.
    """
    positions = camera_centers(cameras)
    forward = cameras.forward.double().numpy(force=True)
    mean = positions.mean(0)
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    offsets = np.einsum("nij,nj->i", across, positions - mean)
    return mean + np.linalg.lstsq(across.sum(0), offsets, rcond=1e-6)[0]


def directions_from(cameras: Camera, center: Float[np.ndarray, "3"]) -> Float[np.ndarray, "n 3"]:
    """Unit directions from the centre to the cameras; zero for a camera that stands on it."""
    away = camera_centers(cameras) - center
    distance = np.linalg.norm(away, axis=1, keepdims=True)
    apart = distance > _SAME_PLACE * max(1.0, float(np.abs(center).max()))
    return np.where(apart, away / np.where(apart, distance, 1.0), 0.0)


def facing(
    cameras: Camera, center: Float[np.ndarray, "3"], within_rad: float
) -> Bool[np.ndarray, " n"]:
    """Which cameras have the centre within an angle of their optical axis."""
    forward = cameras.forward.double().numpy(force=True)
    cosine = -(forward * directions_from(cameras, center)).sum(1)
    return cosine > np.cos(within_rad)


def common_center(cameras: Camera) -> Float[np.ndarray, "3"] | None:
    """The scene's centre if there are two cameras or more and all look at it, else None."""
    center = scene_center(cameras)
    look_at_it = len(cameras.world_to_cam) > 1 and facing(cameras, center, LOOKS_AT_RAD).all()
    return center if look_at_it else None


def pairwise_angles(cameras: Camera, center: Float[np.ndarray, "3"]) -> Float[np.ndarray, "n n"]:
    """Angles in [0, π] between viewing directions as seen from the scene's centre."""
    directions = directions_from(cameras, center)
    angles = np.arccos(np.clip(directions @ directions.T, -1.0, 1.0))
    np.fill_diagonal(angles, 0.0)
    return angles


def fit_orbit(cameras: Camera) -> Orbit:
    """Fit the axis that the cameras circle the scene's centre around.

    The axis is the direction in which the viewing *directions* vary least: distances drop out, so
    that an ellipse is as good as a circle, and their mean is taken off, so that a high orbit is
    as good as a level one.
    """
    center = scene_center(cameras)
    directions = directions_from(cameras, center)
    first, _, axis = np.linalg.svd(directions - directions.mean(0))[2]
    up = -cameras.world_to_cam[:, 1, :3].double().numpy(force=True).mean(0)
    if axis @ up < 0:
        axis = -axis
    azimuths = np.arctan2(directions @ np.cross(axis, first), directions @ first)
    elevations = np.arcsin(np.clip(directions @ axis, -1.0, 1.0))
    return Orbit(axis, center, azimuths % (2 * np.pi), elevations)


def references_by_nearness(references: Camera, queries: Camera) -> Int[np.ndarray, "q n"]:
    """Indices of all references for each query, nearest first, ties by index.

    Nearness is the angle between viewing directions at the point that the references look at;
    where they have none in common (one camera, parallel axes), the distance between positions.
    """
    center = common_center(references)
    if center is not None:
        cosines = directions_from(queries, center) @ directions_from(references, center).T
        farness = np.arccos(np.clip(cosines, -1.0, 1.0))
    else:
        offsets = camera_centers(queries)[:, None] - camera_centers(references)
        farness = np.linalg.norm(offsets, axis=-1)
    return np.argsort(farness, axis=1, kind="stable")


def extra_references(
    angles_rad: Float[np.ndarray, "n n"],
    query: int,
    first: int,
    count: int,
    rng: np.random.Generator,
    allowed: Int[np.ndarray, " m"],
) -> tuple[int, ...]:
    """Draw references behind the first, up to `count` with it; `first` stays the nearest.

    Each is drawn with a probability that grows with the square of its angle to the nearest one so
    far (k-means++), so that references spread around the scene instead of crowding. Returned
    nearest to the query first.
    """
    behind = angles_rad[query, allowed] >= angles_rad[query, first]
    pool = allowed[behind & (allowed != query) & (allowed != first)]
    chosen: list[int] = []
    apart = angles_rad[first, pool]
    while len(chosen) < count - 1 and apart.any():
        drawn = pool[rng.choice(len(pool), p=apart**2 / (apart**2).sum())]
        chosen.append(int(drawn))
        apart = np.minimum(apart, angles_rad[drawn, pool])
    return tuple(sorted(chosen, key=lambda frame: (angles_rad[query, frame], frame)))


def farthest_point_sample(
    positions: Float[np.ndarray, "n d"], count: int, start: int = 0
) -> Int[np.ndarray, " k"]:
    """Indices of points, each the farthest from those before it; ties by index."""
    if not 1 <= count <= len(positions):
        raise ValueError(f"cannot choose {count} of {len(positions)} points")
    chosen = [start]
    distance = np.linalg.norm(positions - positions[start], axis=1)
    while len(chosen) < count:
        distance[chosen[-1]] = -1.0
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(positions - positions[chosen[-1]], axis=1))
    return np.array(chosen)
