"""Lenses that bend straight lines, and the pinhole camera that is left when that is undone."""

from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Float, Shaped

MAX_ZOOM = 4.0
"""A lens that needs more to fill the picture is beyond what a pinhole camera can show."""
_BORDER_SAMPLES = 64
_RAY_SAMPLES = 64
_RAY_STEP = 1e-4
"""Share of a ray's length over which the lens's radial derivative is taken."""
_BISECTIONS = 24
_OPENCV_CENTRE = 0.5
"""OpenCV puts the top-left pixel's centre at (0, 0), we at (0.5, 0.5)."""


@dataclass(frozen=True)
class Lens:
    """Pinhole intrinsics in pixels (our pixel centres) and OpenCV's distortion coefficients."""

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    """k1, k2, p1, p2[, k3[, k4, k5, k6]]; of a fisheye lens k1, k2, k3, k4."""
    fisheye: bool = False
    radial_r8: float = 0.0
    """Brown's fourth radial coefficient, of r⁸, which OpenCV does not have; needs at most five of
    the others, and no fisheye."""

    @property
    def is_pinhole(self) -> bool:
        """Whether there is nothing to undo."""
        return not (self.fisheye or any(self.distortion) or self.radial_r8)

    @property
    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """The intrinsics as a matrix, without the distortion."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], np.float64)

    def resized(self, scale_x: float, scale_y: float) -> "Lens":
        """The lens of the same picture at another size."""
        return replace(
            self,
            fx=self.fx * scale_x,
            fy=self.fy * scale_y,
            cx=self.cx * scale_x,
            cy=self.cy * scale_y,
        )

    @lru_cache(maxsize=1024)  # noqa: B019  # all frames of a capture ask the same
    def pinhole(self, height: int, width: int) -> "Lens":
        """The lens of the undistorted picture: zoomed in just until no pixel of it is empty.

        Raises ValueError where no zoom up to `MAX_ZOOM` does.
        """
        straight = replace(self, distortion=(), fisheye=False, radial_r8=0.0)
        if self.is_pinhole or _fills(self, straight, height, width):
            return straight
        low, high = 1.0, MAX_ZOOM
        if not _fills(self, _zoom(straight, high), height, width):
            raise ValueError("the lens distortion cannot be undone: no part of the picture is left")
        for _ in range(_BISECTIONS):
            middle = (low + high) / 2
            if _fills(self, _zoom(straight, middle), height, width):
                high = middle
            else:
                low = middle
        return _zoom(straight, high)


def undistort(
    picture: Shaped[np.ndarray, "h w *c"], lens: Lens, pinhole: Lens, nearest: bool = False
) -> Shaped[np.ndarray, "h w *c"]:
    """Resample what `lens` saw to what `pinhole` would have seen; depth needs `nearest`."""
    height, width = picture.shape[:2]
    map_x, map_y = _sampling_maps(lens, pinhole, height, width)
    how = cv2.INTER_NEAREST if nearest else cv2.INTER_LINEAR
    # The zoom leaves no pixel empty; at the rim half a pixel of rounding repeats the border.
    return cv2.remap(picture, map_x, map_y, how, borderMode=cv2.BORDER_REPLICATE)


def _sampling_maps(
    lens: Lens, pinhole: Lens, height: int, width: int
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """Where OpenCV finds each pixel of the pinhole's picture in the lens's."""
    if lens.radial_r8:
        pixels = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1)
        directions = (pixels - [pinhole.cx, pinhole.cy]) / [pinhole.fx, pinhole.fy]
        seen = (distort(directions.reshape(-1, 2), lens) - _OPENCV_CENTRE).astype(np.float32)
        return seen[:, 0].reshape(height, width), seen[:, 1].reshape(height, width)
    make_maps = cv2.fisheye.initUndistortRectifyMap if lens.fisheye else cv2.initUndistortRectifyMap
    return make_maps(
        _opencv_matrix(lens),
        _coefficients(lens),
        np.eye(3),
        _opencv_matrix(pinhole),
        (width, height),
        cv2.CV_32FC1,
    )


def distort(points: Float[np.ndarray, "n 2"], lens: Lens) -> Float[np.ndarray, "n 2"]:
    """Where the lens shows directions (x/z, y/z), in pixels."""
    if lens.radial_r8:
        return _distort_brown(points, lens)
    if lens.fisheye:
        pixels = cv2.fisheye.distortPoints(points[None], lens.matrix, _coefficients(lens))
        return pixels.reshape(-1, 2)
    rays = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    zero = np.zeros(3)
    return cv2.projectPoints(rays, zero, zero, lens.matrix, _coefficients(lens))[0].reshape(-1, 2)


def _distort_brown(points: Float[np.ndarray, "n 2"], lens: Lens) -> Float[np.ndarray, "n 2"]:
    """Brown's model with four radial coefficients, as nerfstudio and Metashape have it."""
    k1, k2, p1, p2, k3 = (*lens.distortion, 0.0, 0.0, 0.0, 0.0, 0.0)[:5]
    x, y = points.T
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * lens.radial_r8)))
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.stack([lens.fx * u + lens.cx, lens.fy * v + lens.cy], 1)


def _fills(lens: Lens, pinhole: Lens, height: int, width: int) -> bool:
    """Whether the whole border of the pinhole's picture lies within the lens's picture."""
    u, v = np.linspace(0, width, _BORDER_SAMPLES), np.linspace(0, height, _BORDER_SAMPLES)
    border = np.concatenate(
        [
            np.stack([u, np.zeros_like(u)], 1),
            np.stack([u, np.full_like(u, height)], 1),
            np.stack([np.zeros_like(v), v], 1),
            np.stack([np.full_like(v, width), v], 1),
        ]
    )
    directions = (border - [pinhole.cx, pinhole.cy]) / [pinhole.fx, pinhole.fy]
    seen = distort(directions, lens)
    inside = ((seen >= -1e-6) & (seen <= np.array([width, height]) + 1e-6)).all()
    return bool(inside) and not _folds(lens, directions)


def _folds(lens: Lens, directions: Float[np.ndarray, "n 2"]) -> bool:
    """Whether, on the way out to some direction, the lens shows things nearer to the middle again.

    Beyond such a fold a polynomial says nothing of the lens, and two directions share a pixel.
    """
    ends = np.linspace(0, 1, _RAY_SAMPLES + 1)[1:]
    rays = np.stack([ends - _RAY_STEP, ends])[..., None, None] * directions
    before, after = distort(rays.reshape(-1, 2), lens).reshape(rays.shape)
    moved = (after - before) / [lens.fx, lens.fy]
    return bool(((moved * directions).sum(-1) <= 0).any())


def _zoom(lens: Lens, zoom: float) -> Lens:
    return replace(lens, fx=lens.fx * zoom, fy=lens.fy * zoom)


def _opencv_matrix(lens: Lens) -> Float[np.ndarray, "3 3"]:
    return replace(lens, cx=lens.cx - _OPENCV_CENTRE, cy=lens.cy - _OPENCV_CENTRE).matrix


def _coefficients(lens: Lens) -> Float[np.ndarray, " k"]:
    """OpenCV takes 4, 5 or 8 numbers; missing ones are zero."""
    wanted = next(n for n in (4, 5, 8) if n >= len(lens.distortion))
    return np.array(lens.distortion + (0.0,) * (wanted - len(lens.distortion)), np.float64)
