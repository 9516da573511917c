"""Softmax splatting on the CPU: every thread owns a band of rows, so no atomics and the same bits
on any count."""

import math

import numba
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.geometry.splat_compiled import compiled
from extrap_train.geometry.splat_kernel import DEPTH_SHARPNESS, OUTSIDE, ScreenPoints

_ONE = np.float32(1)
_HALF = np.float32(0.5)
_OUTSIDE = np.float32(OUTSIDE)
_SHARPNESS = np.float32(DEPTH_SHARPNESS)
_NEGLIGIBLE = np.float32(60.0)
"""Exponent beyond which a point weighs nothing."""
_USUAL_LANES = 8
_LN2, _PER_LN2 = np.float32(math.log(2)), np.float32(1 / math.log(2))
_SIXTH, _24TH, _120TH = (np.float32(1 / math.factorial(n)) for n in (3, 4, 5))
_POWERS = np.float32(2.0) ** -np.arange(90, dtype=np.float32)


def splat_pixels_numba(
    points: ScreenPoints, values: Float[Tensor, "n c"], size: tuple[int, int, int]
) -> Float[Tensor, "b h w c1"]:
    """Weighted sums of the values, and the summed weight as the last channel, for `size` = (b, h,
    w)."""
    images, height, width = size
    starts = torch.searchsorted(points.image, torch.arange(images + 1))
    columns = (points.u, points.v, points.depth, points.reach_u, points.reach_v, values, starts)
    summed = torch.zeros(images, height, width, values.shape[1] + 1)
    bands = -(-numba.get_num_threads() // images)
    _splat(*(x.detach().numpy() for x in columns), bands, summed.numpy())
    return summed


@compiled(parallel=True)
def _splat(
    u: np.ndarray,
    v: np.ndarray,
    depth: np.ndarray,
    reach_u: np.ndarray,
    reach_v: np.ndarray,
    values: np.ndarray,
    starts: np.ndarray,
    bands: int,
    summed: np.ndarray,
) -> None:
    images, height, width, _ = summed.shape
    nearest = np.full((images, height, width), np.float32(np.inf), np.float32)
    for task in numba.prange(images * bands):
        image, band = task // bands, task % bands
        rows = (height * band // bands, height * (band + 1) // bands)
        span = (starts[image], starts[image + 1])
        _find_nearest(u, v, depth, reach_u, reach_v, span, rows, nearest[image])
        _add(u, v, depth, values, span, rows, nearest[image], summed[image])


@compiled()
def _find_nearest(
    u: np.ndarray,
    v: np.ndarray,
    depth: np.ndarray,
    reach_u: np.ndarray,
    reach_v: np.ndarray,
    span: tuple[int, int],
    rows: tuple[int, int],
    nearest: np.ndarray,
) -> None:
    """Least depth of the points that reach each pixel's centre."""
    top, bottom = rows
    width = nearest.shape[1]
    for i in range(span[0], span[1]):
        if not _touches(u[i], v[i], top, bottom, width):
            continue
        y, down = _split(v[i])
        x, right = _split(u[i])
        for dy in range(2):
            apart_y = _ONE - down if dy else down
            if not (top <= y + dy < bottom and apart_y <= reach_v[i]):
                continue
            for dx in range(2):
                apart_x = _ONE - right if dx else right
                inside = 0 <= x + dx < width and apart_x <= reach_u[i]
                if inside and (_ONE - apart_x) * (_ONE - apart_y) > 0:
                    nearest[y + dy, x + dx] = min(nearest[y + dy, x + dx], depth[i])


@compiled(contract=True)
def _add(  # noqa: C901  in one piece: a call in the inner loop costs a third of the time
    u: np.ndarray,
    v: np.ndarray,
    depth: np.ndarray,
    values: np.ndarray,
    span: tuple[int, int],
    rows: tuple[int, int],
    nearest: np.ndarray,
    summed: np.ndarray,
) -> None:
    """Add the points' values to the pixels around them, by kernel and depth."""
    top, bottom = rows
    width, channels = nearest.shape[1], values.shape[1]
    lanes = np.ones(channels + 1, np.float32)  # the point's values, and 1 to sum the weights
    for i in range(span[0], span[1]):
        if not _touches(u[i], v[i], top, bottom, width):
            continue
        y, down = _split(v[i])
        x, right = _split(u[i])
        for c in range(channels):
            lanes[c] = values[i, c]
        for dy in range(2):
            if not top <= y + dy < bottom:
                continue
            row = np.uint32(y + dy)  # unsigned: no check for an index from the end
            kernel_y = down if dy else _ONE - down
            for dx in range(2):
                if not 0 <= x + dx < width:
                    continue
                column = np.uint32(x + dx)
                least = nearest[row, column]
                exponent = _SHARPNESS * (abs(depth[i] - least) / least)
                if not exponent < _NEGLIGIBLE:
                    continue
                kernel_x = right if dx else _ONE - right
                weight = kernel_x * kernel_y * _exp_minus(exponent)
                if channels + 1 == _USUAL_LANES:  # known when compiled: one vector instruction
                    for c in range(_USUAL_LANES):
                        summed[row, column, c] += weight * lanes[c]
                else:
                    for c in range(channels + 1):
                        summed[row, column, c] += weight * lanes[c]


@compiled(contract=True)
def _exp_minus(x: float) -> float:
    """exp(−x) for 0 ≤ x < 60 to 2·10⁻⁶: a power of two from a table times a polynomial on ±ln 2 /
    2."""
    whole = np.uint32(x * _PER_LN2 + _HALF)
    rest = np.float32(whole) * _LN2 - x
    series = _ONE + rest * (
        _ONE + rest * (_HALF + rest * (_SIXTH + rest * (_24TH + rest * _120TH)))
    )
    return series * _POWERS[whole]


@compiled()
def _touches(u: float, v: float, top: int, bottom: int, width: int) -> bool:
    """Whether a point lies within a pixel of the rows and columns; false for NaN, too."""
    in_rows = np.float32(top) - _HALF <= v < np.float32(bottom) + _HALF
    return bool(in_rows and -_HALF <= u < np.float32(width) + _HALF)


@compiled()
def _split(position: float) -> tuple[np.int32, np.floating]:
    """Whole and fractional part of a coordinate, counted from pixel centres."""
    shifted = position - _HALF
    whole = np.float32(math.floor(shifted))
    return np.int32(whole), shifted - whole


def project_numba(
    world_points: Float[Tensor, "n 3"], pixels_from_world: Float[Tensor, "3 4"]
) -> Float[Tensor, "3 n"]:
    """Pixel u, v and depth; points at or behind the camera land outside every image, at depth 1."""
    screen = torch.empty(3, len(world_points))
    _project(
        world_points.contiguous().numpy(), pixels_from_world.contiguous().numpy(), screen.numpy()
    )
    return screen


@compiled(parallel=True)
def _project(points: np.ndarray, m: np.ndarray, screen: np.ndarray) -> None:
    for i in numba.prange(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        depth = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
        if depth > 0:
            screen[0, i] = (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]) / depth
            screen[1, i] = (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]) / depth
            screen[2, i] = depth
        else:
            screen[0, i], screen[1, i], screen[2, i] = _OUTSIDE, _OUTSIDE, _ONE
