"""Cameras of other programs, for the tests of their readers: what such a camera must show.

Nothing here uses the product: points are projected by the directions that a camera's axes have in
the world.
"""

from dataclasses import dataclass

import numpy as np
from PIL import Image

WIDTH, HEIGHT = 40, 30
POINTS = np.array([[0.0, 0.1, 0.0], [0.5, -0.3, 0.2], [-0.5, 0.3, 0.3], [0.4, 0.4, -0.4]])
"""In the world; every `shot` shows them."""
DOT_PIXELS = 2.0


@dataclass(frozen=True)
class Shot:
    """A camera by its axes in the world."""

    position: np.ndarray
    right: np.ndarray
    up: np.ndarray
    forward: np.ndarray
    fx: float = 50.0
    fy: float = 52.0
    cx: float = 19.0
    cy: float = 15.5

    def directions(self, points=POINTS):
        """To the right and downwards, as shares of the distance forward."""
        offset = points - self.position
        ahead = offset @ self.forward
        return offset @ self.right / ahead, -(offset @ self.up) / ahead

    def pixels(self, points=POINTS):
        """Where a pinhole camera shows points; the first pixel's centre is (0.5, 0.5)."""
        x, y = self.directions(points)
        return np.stack([self.fx * x + self.cx, self.fy * y + self.cy], 1)

    @property
    def opengl_matrix(self):
        """Camera-to-world."""
        axes = [self.right, self.up, -self.forward, self.position]
        return np.vstack([np.stack(axes, 1), [0, 0, 0, 1]])

    @property
    def opencv_matrix(self):
        """Camera-to-world."""
        axes = [self.right, -self.up, self.forward, self.position]
        return np.vstack([np.stack(axes, 1), [0, 0, 0, 1]])


def shot(azimuth_deg, world_up=(0.0, 1.0, 0.0), **lens):
    """A camera two units from the origin, slightly above it and rolled, that looks past it."""
    angle = np.deg2rad(azimuth_deg)
    world_up = np.array(world_up)
    side = np.roll(world_up, 1)
    position = 2 * (np.cos(angle) * side + np.sin(angle) * np.cross(world_up, side)) + world_up
    forward = _unit(0.05 * side - position)
    level = _unit(np.cross(forward, world_up))
    right = _unit(level + 0.1 * np.cross(level, forward))
    return Shot(position, right, np.cross(right, forward), forward, **lens)


def shots(count=3, **options):
    return [shot(40.0 * index, **options) for index in range(count)]


def save_picture(path, width=WIDTH, height=HEIGHT, seed=0):
    path.parent.mkdir(parents=True, exist_ok=True)
    noise = np.random.default_rng(seed).integers(0, 255, (height, width, 3), dtype=np.uint8)
    Image.fromarray(noise).save(path)


def save_dot(path, pixel, width, height):
    """A picture of one bright dot, centred where a camera shows a point."""
    path.parent.mkdir(parents=True, exist_ok=True)
    v, u = np.mgrid[:height, :width] + 0.5
    grey = 255 * np.exp(-((u - pixel[0]) ** 2 + (v - pixel[1]) ** 2) / 2 / DOT_PIXELS**2)
    Image.fromarray(np.repeat(grey.round().astype(np.uint8)[..., None], 3, 2)).save(path)


def dot_of(image):
    """Where a picture, `3 h w`, shows its dot."""
    grey = image[0].double().numpy()
    grey = np.where(grey > 0.1, grey, 0)
    v, u = np.mgrid[: grey.shape[0], : grey.shape[1]] + 0.5
    return np.array([(grey * u).sum(), (grey * v).sum()]) / grey.sum()


def pixels_of(camera, points=POINTS):
    """Where a camera that was read shows points."""
    world_to_cam = camera.world_to_cam.double().numpy()
    seen = (points @ world_to_cam[:3, :3].T + world_to_cam[:3, 3]) @ camera.intrinsics.numpy().T
    assert (seen[:, 2] > 0).all()
    return seen[:, :2] / seen[:, 2:]


def _unit(vector):
    return vector / np.linalg.norm(vector)
