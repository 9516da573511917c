"""Where cameras stand around a scene: its centre, their orbit, the angles between them; and cameras
that circle it.

Everything here is numpy in float64: a few hundred viewpoints a sequence, and what is decided from
them (filter, pairs, protocol) must not depend on a device. Only poses matter; image sizes and
intrinsics are not looked at.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from extrap_train.views import Camera

LOOKS_AT_RAD = np.deg2rad(60)
"""Largest angle between an optical axis and a point that the camera is said to look at."""
MIN_VIEWS = 3
"""Fewer do not show which way their orbit leans."""
_SAME_PLACE = 1e-9
"""Distances below this share of the scene's extent are zero."""


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


Angles = Float[np.ndarray, "*n"] | float


@dataclass(frozen=True)
class Orbit:
    """A way around a scene: azimuths about an axis, elevations towards it."""

    center: Float[np.ndarray, "3"]
    axis: Float[np.ndarray, "3"]
    """Unit length, upwards in the photographs."""
    east: Float[np.ndarray, "3"]
    """Unit length; azimuth 0."""

    @classmethod
    def around(
        cls, center: Float[np.ndarray, "3"], axis: Float[np.ndarray, "3"], views: Camera
    ) -> "Orbit":
        """Starts at the first of the views."""
        first = directions_from(views[:1], center)[0]
        east = first - (first @ axis) * axis
        return cls(center, axis, east / np.linalg.norm(east))

    def locate(
        self, positions: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Azimuths in [0, 2π), elevations in [−π/2, π/2], both in radians, and distances.

        An azimuth means nothing near the axis; both are 0 for a position on the centre.
        """
        offsets = positions - self.center
        distances = np.linalg.norm(offsets, axis=1)
        away, north = np.where(distances > 0, distances, 1), np.cross(self.axis, self.east)
        directions = offsets / away[:, None]
        azimuths = np.arctan2(directions @ north, directions @ self.east) % (2 * np.pi)
        return azimuths, np.arcsin(np.clip(offsets @ self.axis / away, -1, 1)), distances

    def poses(
        self, azimuths_rad: Float[np.ndarray, " n"], elevation_rad: Angles, distance: Angles
    ) -> Float[np.ndarray, "n 4 4"]:
        """`world_to_cam` of cameras that stand there, look at the centre and are held upright."""
        azimuth = azimuths_rad[:, None]
        elevation, far = (
            np.broadcast_to(x, len(azimuth))[:, None] for x in (elevation_rad, distance)
        )
        north = np.cross(self.axis, self.east)
        level = np.cos(azimuth) * self.east + np.sin(azimuth) * north
        out = np.cos(elevation) * level + np.sin(elevation) * self.axis
        return looking_at(self.center + far * out, self.center, self.axis)


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
    return Orbit(center, axis, first)


def fit_orbit_of_few(cameras: Camera) -> Orbit:
    """The orbit of two or more cameras that look at a scene from one side or from all.

    The axis is the direction that the cameras' horizontal axes have least in common with: a few
    photographs from one side do not show which way their positions bend, but all are held upright,
    or all on their side. The horizontal axis is the one that turns as the cameras go around: the
    images' rows, or the columns of photographs on their side, whose orbit may be upside down. Two
    photographs are taken as upright: they may stand above each other.
    """
    rows, columns = cameras.world_to_cam[:, :2, :3].double().numpy(force=True).swapaxes(0, 1)
    (rows_turn, axis), (columns_turn, axis_on_side) = map(_least_common, (rows, columns))
    up = -columns.mean(0)
    if len(rows) >= MIN_VIEWS and columns_turn > rows_turn:
        axis, up = axis_on_side, rows.mean(0)
    return Orbit.around(scene_center(cameras), axis if axis @ up > 0 else -axis, cameras)


def _least_common(
    directions: Float[np.ndarray, "n 3"],
) -> tuple[float, Float[np.ndarray, "3"]]:
    """How far directions turn about an axis, from 0 to 1/2 on average, and this axis."""
    shares, axes = np.linalg.eigh(directions.T @ directions / len(directions))
    return float(shares[1]), axes[:, 0]


def orbit_cameras(views: Camera, span_rad: float, count: int) -> Camera:
    """`count` cameras in equal steps of `span_rad / count` from the first view's azimuth on.

    They stand at the views' median elevation and distance, look at the point that these look at
    with the orbit's axis up, and have their median focal length around the image's middle. A full
    turn does not repeat its first camera. Raises ValueError for fewer than three views.
    """
    if len(views.world_to_cam) < MIN_VIEWS:
        raise ValueError(f"an orbit needs {MIN_VIEWS} views, not {len(views.world_to_cam)}")
    orbit = fit_orbit(views)
    orbit = Orbit.around(orbit.center, orbit.axis, views)
    _, elevations_rad, distances = orbit.locate(camera_centers(views))
    azimuths_rad = span_rad / count * np.arange(count)
    matrices = orbit.poses(azimuths_rad, np.median(elevations_rad), np.median(distances))
    return Camera(
        torch.from_numpy(matrices).to(views.world_to_cam.dtype),
        _central_lens(views).expand(count, 3, 3).clone(),
        views.height,
        views.width,
    )


def turn_camera(
    camera: Camera,
    pivot: Float[np.ndarray, "3"],
    axis: Float[np.ndarray, "3"],
    angles_rad: Float[np.ndarray, " n"],
) -> Camera:
    """A camera carried around the axis (unit length) through the pivot, once for every angle.

    Right-handed: seen from the axis's tip, a positive angle is counter-clockwise. What the camera
    sees of the pivot, its distance and its place in the image, stays.
    """
    turns = np.tile(np.eye(4), (len(angles_rad), 1, 1))
    turns[:, :3, :3] = Rotation.from_rotvec(angles_rad[:, None] * axis).as_matrix()
    turns[:, :3, 3] = pivot - turns[:, :3, :3] @ pivot
    cam_to_world = turns @ camera.cam_to_world.double().numpy(force=True)
    return Camera(
        torch.from_numpy(np.linalg.inv(cam_to_world)).to(camera.world_to_cam),
        camera.intrinsics.expand(len(angles_rad), 3, 3).clone(),
        camera.height,
        camera.width,
    )


def looking_at(
    positions: Float[np.ndarray, "n 3"],
    target: Float[np.ndarray, "#n 3"] | Float[np.ndarray, "3"],
    up: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "n 4 4"]:
    """`world_to_cam` of cameras that look at one point or each at its own, with `up` upwards in
    their images."""
    forward = target - positions
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    rotation = np.stack([right, np.cross(forward, right), forward], 1)
    matrices = np.tile(np.eye(4), (len(positions), 1, 1))
    matrices[:, :3, :3] = rotation
    matrices[:, :3, 3] = -np.einsum("nij,nj->ni", rotation, positions)
    return matrices


def _central_lens(views: Camera) -> Float[torch.Tensor, "3 3"]:
    focal = views.intrinsics.diagonal(dim1=-2, dim2=-1)[:, :2].median(0).values
    lens = torch.eye(3, dtype=focal.dtype)
    lens[0, 0], lens[1, 1] = focal
    lens[0, 2], lens[1, 2] = views.width / 2, views.height / 2
    return lens
