"""Where views are made, and which one next (paper II-B: about 30° at a time)."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from extrap_train.geometry.viewpoints import (
    camera_centers,
    fit_orbit_of_few,
    pairwise_angles,
    scene_center,
)
from extrap_train.geometry.warp import warp_references
from extrap_train.reconstruction.global_map import GlobalMap
from extrap_train.views import Camera, stack_cameras

NEAREST_RAD, FARTHEST_RAD = np.radians(20), np.radians(40)
"""Range of a query's angle from the nearest known view."""
PREVIEW_SIZE = 32
"""Pixels of the warps that coverage is measured on."""
SAME_COVERAGE = 0.1
"""Shares of the picture that differ by less are as good."""
REFERENCES = 3
"""Views that a picture is warped from (paper II-A)."""


@dataclass(frozen=True)
class Query:
    """A view that is to be made."""

    name: str
    camera: Camera


def orbit_queries(cameras: Camera, step_rad: float) -> list[Query]:
    """Views that fill the gaps between the inputs' azimuths in even steps of about `step_rad`.

    Elevation and distance go over from one end of a gap to the other.
    """
    orbit = fit_orbit_of_few(cameras)
    azimuths, elevations, distances = orbit.locate(camera_centers(cameras))
    order = np.argsort(azimuths, kind="stable")
    queries = []
    around = azimuths[order]
    gaps = np.diff(around, append=around[0] + 2 * np.pi)
    for one, other, gap in zip(order, np.roll(order, -1), gaps, strict=True):
        steps = max(1, round(gap / step_rad))
        shares = np.arange(1, steps) / steps
        gap_azimuths = azimuths[one] + shares * gap
        elevation, distance = (
            (1 - shares) * x[one] + shares * x[other] for x in (elevations, distances)
        )
        made = _cameras_at(orbit.poses(gap_azimuths, elevation, distance), cameras)
        queries += [
            Query(f"orbit{round(np.degrees(azimuth)) % 360:03d}", made[i])
            for i, azimuth in enumerate(gap_azimuths)
        ]
    return queries


def circle_cameras(cameras: Camera, first: Float[np.ndarray, "3"], count: int) -> Camera:
    """`count` cameras evenly around the scene, the first one towards the point `first`, at the
    mean height and distance of some.
    """
    orbit = fit_orbit_of_few(cameras)
    (start,), _, _ = orbit.locate(first[None])
    _, elevations, distances = orbit.locate(camera_centers(cameras))
    azimuths = start + 2 * np.pi * np.arange(count) / count
    return _cameras_at(orbit.poses(azimuths, elevations.mean(), distances.mean()), cameras)


def _cameras_at(world_to_cam: Float[np.ndarray, "n 4 4"], like: Camera) -> Camera:
    """Cameras with the median intrinsics of others."""
    intrinsics = like.intrinsics.median(0).values.expand(len(world_to_cam), 3, 3).clone()
    matrices = torch.from_numpy(world_to_cam).float()
    return Camera(matrices, intrinsics, like.height, like.width)


def next_query(scene_map: GlobalMap, queries: list[Query]) -> Query:
    """The query that the map covers best, of those 20–40° from their nearest known view.

    Of equals, the one farthest from the newest view, so that branches grow in turn. Where none is
    in range, the nearest one.
    """
    cameras = stack_cameras([*(v.camera for v in scene_map.views), *(q.camera for q in queries)])
    count = len(scene_map)
    angles = pairwise_angles(cameras, scene_center(scene_map.cameras))[count:, :count]
    nearest = angles.min(1)
    in_range = (nearest >= NEAREST_RAD - 1e-6) & (nearest <= FARTHEST_RAD + 1e-6)
    if not in_range.any():
        return queries[int(nearest.argmin())]
    candidates = np.flatnonzero(in_range)
    covered = np.array([coverage(scene_map, queries[i].camera) for i in candidates])
    best = candidates[covered >= covered.max() - SAME_COVERAGE]
    return queries[best[angles[best, -1].argmax()]]


def expected_order(scene_map: GlobalMap, queries: list[Query]) -> list[Query]:
    """The queries as angles alone order them, nearest first, branches in turn; coverage, which
    nobody knows before the views are made, may change it.
    """
    cameras = stack_cameras([*(v.camera for v in scene_map.views), *(q.camera for q in queries)])
    angles = pairwise_angles(cameras, scene_center(scene_map.cameras))
    reached = list(range(len(scene_map)))
    left = list(range(len(scene_map), len(angles)))
    order = []
    while left:
        nearest = angles[np.ix_(left, reached)].min(1)
        equal = np.flatnonzero(nearest <= nearest.min() + NEAREST_RAD / 2)
        best = left[int(equal[angles[left][equal, reached[-1]].argmax()])]
        order.append(queries[best - len(scene_map)])
        reached.append(best)
        left.remove(best)
    return order


def coverage(scene_map: GlobalMap, camera: Camera) -> float:
    """Share of the camera's picture that the nearest views reach, generated ones included: what a
    new view can be aligned to.
    """
    views = [scene_map.views[i] for i in scene_map.nearest(camera, REFERENCES)]
    small = [view.view.resized(PREVIEW_SIZE, PREVIEW_SIZE) for view in views]
    depths = torch.stack([view.depth for view in small if view.depth is not None])
    warp = warp_references(
        torch.stack([view.image for view in small])[None],
        depths[None],
        stack_cameras([stack_cameras([view.camera for view in small])]),
        torch.ones(1, len(small), dtype=torch.bool),
        stack_cameras([camera.resized(PREVIEW_SIZE, PREVIEW_SIZE)]),
    )
    return float(warp.mask.mean())
