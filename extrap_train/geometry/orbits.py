"""Circles of cameras around what a few views look at."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from extrap_train.geometry.viewpoints import (
    camera_centers,
    directions_from,
    fit_orbit,
    scene_center,
)
from extrap_train.views import Camera

MIN_VIEWS = 3
"""Fewer do not show which way their orbit leans."""

Angles = Float[np.ndarray, "*n"] | float


@dataclass(frozen=True)
class Circle:
    """A way around a scene: azimuths about an axis, elevations towards it."""

    center: Float[np.ndarray, "3"]
    axis: Float[np.ndarray, "3"]
    """Unit length, upwards in the photographs."""
    east: Float[np.ndarray, "3"]
    """Unit length; azimuth 0, where the first view stands."""

    @classmethod
    def around(
        cls, center: Float[np.ndarray, "3"], axis: Float[np.ndarray, "3"], views: Camera
    ) -> "Circle":
        """Starts at the first of the views."""
        first = directions_from(views[:1], center)[0]
        east = first - (first @ axis) * axis
        return cls(center, axis, east / np.linalg.norm(east))

    def locate(
        self, positions: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Azimuths in [0, 2π), elevations in [−π/2, π/2], both in radians, and distances."""
        offsets = positions - self.center
        distances = np.linalg.norm(offsets, axis=1)
        directions, north = offsets / distances[:, None], np.cross(self.axis, self.east)
        azimuths = np.arctan2(directions @ north, directions @ self.east) % (2 * np.pi)
        return azimuths, np.arcsin(np.clip(offsets @ self.axis / distances, -1, 1)), distances

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


def fit_circle(cameras: Camera) -> Circle:
    """The circle of two or more cameras that look at a scene from one side or from all.

    The axis is the direction that the cameras' horizontal axes have least in common with: a few
    photographs from one side do not show which way their positions bend, but all are held upright.
    """
    right = cameras.world_to_cam[:, 0, :3].double().numpy(force=True)
    axis = np.linalg.eigh(right.T @ right)[1][:, 0]
    up = -cameras.world_to_cam[:, 1, :3].double().numpy(force=True).mean(0)
    return Circle.around(scene_center(cameras), axis if axis @ up > 0 else -axis, cameras)


def orbit_cameras(views: Camera, span_rad: float, count: int) -> Camera:
    """`count` cameras in equal steps of `span_rad / count` from the first view's azimuth on.

    They stand at the views' median elevation and distance, look at the point that these look at
    with the orbit's axis up, and have their median focal length around the image's middle. A full
    turn does not repeat its first camera. Raises ValueError for fewer than three views.
    """
    if len(views.world_to_cam) < MIN_VIEWS:
        raise ValueError(f"an orbit needs {MIN_VIEWS} views, not {len(views.world_to_cam)}")
    orbit = fit_orbit(views)
    circle = Circle.around(orbit.center, orbit.axis, views)
    _, elevations_rad, distances = circle.locate(camera_centers(views))
    azimuths_rad = span_rad / count * np.arange(count)
    matrices = circle.poses(azimuths_rad, np.median(elevations_rad), np.median(distances))
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
