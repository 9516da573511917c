"""Perspective views out of pictures that show more than one can: panoramas and very wide fisheyes.

Directions are in the axes of the picture's camera: +X right, +Y down, +Z to the picture's middle.
"""

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Float, Shaped

from extrap_train.geometry.lens import Lens

PANORAMA_YAWS_DEG = tuple(range(0, 360, 60))
FOV_DEG = 90.0
"""Field of view of a cut, both ways: neighbours of a panorama share a third of it."""
MIN_YAW_DEG = 15
"""Cuts of a fisheye that are turned by less show little more than the one straight ahead."""
_BORDER_SAMPLES = 64
_OPENCV_CENTRE = 0.5


@dataclass(frozen=True)
class Equirectangular:
    """All directions, 360 degrees wide and 180 degrees high, at equal angles."""

    def project(
        self, directions: Float[np.ndarray, "*n 3"], height: int, width: int
    ) -> Float[np.ndarray, "*n 2"]:
        """Where directions are shown, in pixels (u, v) of a picture of this size."""
        x, y, z = np.moveaxis(directions, -1, 0)
        longitude, latitude = np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))
        u, v = longitude / (2 * np.pi) + 0.5, latitude / np.pi + 0.5
        return np.stack([u * width, v * height], -1)


@dataclass(frozen=True)
class Cut:
    """A square perspective view of `FOV_DEG` out of a wider picture."""

    source: Lens | Equirectangular
    height: int
    width: int
    """Size of the whole picture, in pixels."""
    yaw_deg: int
    """Angle from the picture's middle to the right, in [0, 360)."""

    @property
    def side(self) -> int:
        """In pixels; in its middle the cut is as fine as the picture."""
        source = self.source
        pixels_per_rad = source.fx if isinstance(source, Lens) else self.width / (2 * np.pi)
        return max(1, round(2 * pixels_per_rad * math.tan(math.radians(FOV_DEG / 2))))

    @property
    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """The cut's pinhole intrinsics."""
        half = self.side / 2
        focal = half / math.tan(math.radians(FOV_DEG / 2))
        return np.array([[focal, 0, half], [0, focal, half], [0, 0, 1]])

    @property
    def cut_from_picture(self) -> Float[np.ndarray, "3 3"]:
        """Rotation from the picture's axes to those of the cut."""
        yaw = math.radians(self.yaw_deg)
        cos, sin = math.cos(yaw), math.sin(yaw)
        return np.array([[cos, 0, -sin], [0, 1, 0], [sin, 0, cos]])

    def extract(
        self, picture: Shaped[np.ndarray, "h w *c"], nearest: bool = False
    ) -> Shaped[np.ndarray, "s s *c"]:
        """What of the picture the cut shows; without mixing values if `nearest`."""
        u, v = np.meshgrid(np.arange(self.side) + 0.5, np.arange(self.side) + 0.5)
        at = (self._project(u, v) - _OPENCV_CENTRE).astype(np.float32)
        how = cv2.INTER_NEAREST if nearest else cv2.INTER_LINEAR
        is_lens = isinstance(self.source, Lens)
        border = cv2.BORDER_REPLICATE if is_lens else cv2.BORDER_WRAP
        return cv2.remap(picture, at[..., 0], at[..., 1], how, borderMode=border)

    def is_filled(self) -> bool:
        """Whether a fisheye shows all of the cut, and no two directions of it in one pixel."""
        assert isinstance(self.source, Lens)
        ends = np.linspace(0, self.side, _BORDER_SAMPLES)
        zero, side = np.zeros_like(ends), np.full_like(ends, self.side)
        u, v = np.concatenate([ends, ends, zero, side]), np.concatenate([zero, side, ends, ends])
        inside = _are_inside(self._project(u, v), self.height, self.width)
        return inside and not _folds(self.source, self._angles(u, v).max())

    def _directions(
        self, u: Float[np.ndarray, "*n"], v: Float[np.ndarray, "*n"]
    ) -> Float[np.ndarray, "*n 3"]:
        pixels = np.stack([u, v, np.ones_like(u)], -1)
        return pixels @ np.linalg.inv(self.matrix).T @ self.cut_from_picture

    def _angles(
        self, u: Float[np.ndarray, "*n"], v: Float[np.ndarray, "*n"]
    ) -> Float[np.ndarray, "*n"]:
        x, y, z = np.moveaxis(self._directions(u, v), -1, 0)
        return np.arctan2(np.hypot(x, y), z)

    def _project(
        self, u: Float[np.ndarray, "*n"], v: Float[np.ndarray, "*n"]
    ) -> Float[np.ndarray, "*n 2"]:
        directions = self._directions(u, v)
        if isinstance(self.source, Lens):
            return project_fisheye(directions, self.source)
        return self.source.project(directions, self.height, self.width)


def project_fisheye(directions: Float[np.ndarray, "*n 3"], lens: Lens) -> Float[np.ndarray, "*n 2"]:
    """Where OpenCV's fisheye lens shows directions, in pixels; also those behind it, which
    `lens.distort` has no way to write.
    """
    x, y, z = np.moveaxis(directions, -1, 0)
    radius = np.hypot(x, y)
    scale = _bent(lens, np.arctan2(radius, z)) / np.maximum(radius, 1e-12)
    return np.stack([lens.fx * x * scale + lens.cx, lens.fy * y * scale + lens.cy], -1)


@lru_cache(maxsize=1024)  # all pictures of a capture ask the same
def cuts_of(lens: Lens | Equirectangular, height: int, width: int) -> tuple[Cut, ...]:
    """The cuts of a picture; none where one perspective view shows it (`Lens.pinhole`).

    Six around the horizon of a panorama. Of a fisheye that sees 180 degrees or more from left to
    right, one straight ahead and one on either side, as far as the picture fills them.
    """
    if isinstance(lens, Equirectangular):
        return tuple(Cut(lens, height, width, yaw) for yaw in PANORAMA_YAWS_DEG)
    sides = project_fisheye(np.array([[-1.0, 0, 0], [1.0, 0, 0]]), lens) if lens.fisheye else None
    if sides is None or _folds(lens, np.pi / 2) or not _are_inside(sides, height, width):
        return ()
    ahead = Cut(lens, height, width, 0)
    for yaw in range(int(FOV_DEG), MIN_YAW_DEG, -1):
        pair = replace(ahead, yaw_deg=yaw), replace(ahead, yaw_deg=360 - yaw)
        if all(cut.is_filled() for cut in (ahead, *pair)):
            return (ahead, *pair)
    return ()


def _are_inside(pixels: Float[np.ndarray, "*n 2"], height: int, width: int) -> bool:
    return bool(((pixels >= -1e-6) & (pixels <= np.array([width, height]) + 1e-6)).all())


def _bent(lens: Lens, angles_rad: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Distance from the picture's middle, in focal lengths."""
    powers = angles_rad[..., None] ** np.array([3, 5, 7, 9])
    coefficients = (*lens.distortion, 0.0, 0.0, 0.0, 0.0)[:4]
    return angles_rad + powers @ np.array(coefficients)


def _folds(lens: Lens, up_to_rad: float) -> bool:
    """Whether, on the way out, the lens shows things nearer to the middle again."""
    return bool((np.diff(_bent(lens, np.linspace(0, up_to_rad, 1000))) <= 0).any())
