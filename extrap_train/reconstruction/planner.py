"""Where views are made, and which one next (METHOD §5.1; paper II-B: about 30° at a time)."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from extrap_train.geometry.orbits import looking_at
from extrap_train.geometry.viewpoints import (
    camera_centers,
    directions_from,
    pairwise_angles,
    scene_center,
)
from extrap_train.geometry.warp import warp_references
from extrap_train.reconstruction.global_map import GlobalMap
from extrap_train.views import Camera, stack_cameras

NEAREST_RAD, FARTHEST_RAD = np.radians(20), np.radians(40)
"""Of a query, from the nearest known view."""
PREVIEW_SIZE = 32
"""Pixels of the warps that coverage is measured on."""
SAME_COVERAGE = 0.1
"""Shares of the picture that differ by less are as good."""
ORBIT_REFERENCES = 3


@dataclass(frozen=True)
class Query:
    """A view that is to be made."""

    name: str
    camera: Camera


@dataclass(frozen=True)
class Circle:
    """The inputs' way around the scene, as azimuths about an axis."""

    center: Float[np.ndarray, "3"]
    axis: Float[np.ndarray, "3"]
    """Unit length, upwards in the photographs."""
    east: Float[np.ndarray, "3"]
    """Azimuth 0: the first input."""

    def azimuths_rad(self, cameras: Camera) -> Float[np.ndarray, " n"]:
        """In [0, 2π)."""
        directions = directions_from(cameras, self.center)
        north = np.cross(self.axis, self.east)
        return np.arctan2(directions @ north, directions @ self.east) % (2 * np.pi)


def fit_circle(cameras: Camera) -> Circle:
    """The circle of two or more cameras that look at a scene from one side or from all.

    The axis is the direction that the cameras' horizontal axes have least in common with: a few
    photographs from one side do not show which way their positions bend, but all are held upright.
    """
    center = scene_center(cameras)
    right = cameras.world_to_cam[:, 0, :3].double().numpy(force=True)
    axis = np.linalg.eigh(right.T @ right)[1][:, 0]
    up = -cameras.world_to_cam[:, 1, :3].double().numpy(force=True).mean(0)
    axis = axis if axis @ up > 0 else -axis
    first = directions_from(cameras[:1], center)[0]
    east = first - (first @ axis) * axis
    return Circle(center, axis, east / np.linalg.norm(east))


def orbit_queries(cameras: Camera, step_rad: float) -> list[Query]:
    """Views that fill the gaps between the inputs' azimuths in even steps of about `step_rad`.

    Elevation and distance go over from one end of a gap to the other.
    """
    circle = fit_circle(cameras)
    azimuths = circle.azimuths_rad(cameras)
    offsets = camera_centers(cameras) - circle.center
    distances = np.linalg.norm(offsets, axis=1)
    elevations = np.arcsin(np.clip(offsets @ circle.axis / distances, -1, 1))
    order = np.argsort(azimuths, kind="stable")
    queries = []
    for one, other in zip(order, np.roll(order, -1), strict=True):
        gap = (azimuths[other] - azimuths[one]) % (2 * np.pi) or 2 * np.pi
        steps = max(1, round(gap / step_rad))
        for share in np.arange(1, steps) / steps:
            azimuth = azimuths[one] + share * gap
            elevation, distance = (
                (1 - share) * x[one] + share * x[other] for x in (elevations, distances)
            )
            camera = _camera_at(circle, azimuth, elevation, distance, cameras)
            queries.append(Query(f"orbit{round(np.degrees(azimuth)) % 360:03d}", camera))
    return queries


def _camera_at(
    circle: Circle, azimuth_rad: float, elevation_rad: float, distance: float, like: Camera
) -> Camera:
    north = np.cross(circle.axis, circle.east)
    level = np.cos(azimuth_rad) * circle.east + np.sin(azimuth_rad) * north
    out = np.cos(elevation_rad) * level + np.sin(elevation_rad) * circle.axis
    matrix = looking_at((circle.center + distance * out)[None], circle.center, circle.axis)[0]
    intrinsics = like.intrinsics.median(0).values
    return Camera(torch.from_numpy(matrix).float(), intrinsics, like.height, like.width)


def circle_cameras(cameras: Camera, first: Float[np.ndarray, "3"], count: int) -> Camera:
    """`count` cameras evenly around the scene, the first one towards the point `first`, at the
    mean height and distance of some.
    """
    circle = fit_circle(cameras)
    offset = first - circle.center
    north = np.cross(circle.axis, circle.east)
    start = np.arctan2(offset @ north, offset @ circle.east)
    offsets = camera_centers(cameras) - circle.center
    distances = np.linalg.norm(offsets, axis=1)
    elevation = float(np.arcsin(np.clip(offsets @ circle.axis / distances, -1, 1)).mean())
    return stack_cameras(
        [
            _camera_at(circle, start + 2 * np.pi * i / count, elevation, distances.mean(), cameras)
            for i in range(count)
        ]
    )


def next_query(known: GlobalMap, queries: list[Query]) -> Query:
    """The query that the map covers best, of those 20–40° from it; of equals, the one farthest
    from the newest view, so that fronts grow by turns. The nearest one where none is in range.
    """
    cameras = stack_cameras([*(v.camera for v in known.views), *(q.camera for q in queries)])
    angles = pairwise_angles(cameras, scene_center(known.cameras))[len(known) :, : len(known)]
    nearest = angles.min(1)
    in_range = (nearest >= NEAREST_RAD - 1e-6) & (nearest <= FARTHEST_RAD + 1e-6)
    if not in_range.any():
        return queries[int(nearest.argmin())]
    candidates = np.flatnonzero(in_range)
    covered = np.array([coverage(known, queries[i].camera) for i in candidates])
    best = candidates[covered >= covered.max() - SAME_COVERAGE]
    return queries[best[angles[best, -1].argmax()]]


def expected_order(known: GlobalMap, queries: list[Query]) -> list[Query]:
    """The queries as angles alone order them, nearest first, fronts by turns; coverage, which
    nobody knows before the views are made, may change it.
    """
    cameras = stack_cameras([*(v.camera for v in known.views), *(q.camera for q in queries)])
    angles = pairwise_angles(cameras, scene_center(known.cameras))
    reached = list(range(len(known)))
    left = list(range(len(known), len(angles)))
    order = []
    while left:
        nearest = angles[np.ix_(left, reached)].min(1)
        equal = np.flatnonzero(nearest <= nearest.min() + NEAREST_RAD / 2)
        best = left[int(equal[angles[left][equal, reached[-1]].argmax()])]
        order.append(queries[best - len(known)])
        reached.append(best)
        left.remove(best)
    return order


def coverage(known: GlobalMap, camera: Camera) -> float:
    """Share of the camera's picture that its nearest views reach."""
    views = [known.views[i] for i in known.nearest(camera, ORBIT_REFERENCES)]
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
