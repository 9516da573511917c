"""Softmax splatting on the CPU: every thread draws a band of rows, so there are no atomics, and
the same bits come out on any number of them.

A band is drawn into a frame of its own with a margin of one pixel, so that nothing in the inner
loops asks where the image ends; what falls into the margin belongs to a neighbouring band.
"""

import math

import numba
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.geometry.compiled import compiled
from extrap_train.geometry.screen_points import DEPTH_SHARPNESS, OUTSIDE, ScreenPoints

_HALF, _ONE = np.float32(0.5), np.float32(1)
_OUTSIDE = np.float32(OUTSIDE)
_SHARPNESS = np.float32(DEPTH_SHARPNESS)
_NEGLIGIBLE = np.float32(60.0)
"""Exponent from which on a point weighs nothing."""
_BELOW_ONE = np.nextafter(_ONE, np.float32(0))
"""A pixel's centre at a distance of one whole pixel is out of the kernel's reach."""
_INFINITE = np.float32(127 * math.log(2))
"""Exponent that stands for no weight at all: 2⁻¹²⁷ is written with no bits."""
_LN2, _PER_LN2 = np.float32(math.log(2)), np.float32(1 / math.log(2))
_SIXTH, _24TH, _120TH = (np.float32(1 / math.factorial(n)) for n in (3, 4, 5))
_LANES = 8
"""Values are added in vectors of this length."""
_BLOCK = 64
"""Points whose weights are computed at a time."""


def splat_pixels_numba(
    points: ScreenPoints, values: Float[Tensor, "n c"], size: tuple[int, int, int]
) -> Float[Tensor, "b c1 h w"]:
    """Weighted means of the values, and the summed weight as the last channel, for `size` = (b, h,
    w)."""
    images, height, width = size
    starts = torch.searchsorted(points.image, torch.arange(images + 1))
    places = (points.u, points.v, points.depth, points.reach_u, points.reach_v)
    columns = (x.detach().contiguous().numpy() for x in (*places, values, starts))
    means = torch.empty(images, values.shape[1] + 1, height, width)
    bands = -(-numba.get_num_threads() // images)
    _splat(*columns, bands, means.numpy())
    return means


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
    means: np.ndarray,
) -> None:
    images, channels, height, width = means.shape
    lanes = -(-channels // _LANES) * _LANES
    for task in numba.prange(images * bands):
        image, band = task // bands, task % bands
        top, bottom = height * band // bands, height * (band + 1) // bands
        pixels = (bottom - top + 2) * (width + 2)
        nearest = np.full(pixels, np.float32(np.inf), np.float32)
        summed = np.zeros((pixels, lanes), np.float32)
        span = (starts[image], starts[image + 1])
        frame = (top, bottom, width)
        _find_nearest(u, v, depth, reach_u, reach_v, span, frame, nearest)
        _add(u, v, depth, values, span, frame, nearest, summed)
        _write_means(summed, top, bottom, means[image])


@compiled()
def _find_nearest(
    u: np.ndarray,
    v: np.ndarray,
    depth: np.ndarray,
    reach_u: np.ndarray,
    reach_v: np.ndarray,
    span: tuple[int, int],
    frame: tuple[int, int, int],
    nearest: np.ndarray,
) -> None:
    """Least depth of the points that reach each pixel's centre."""
    row = frame[2] + 2
    for i in range(span[0], span[1]):
        if not _touches(u[i], v[i], frame):
            continue
        pixel, right, down = _place(u[i], v[i], frame)
        far_u, far_v = min(reach_u[i], _BELOW_ONE), min(reach_v[i], _BELOW_ONE)
        z = depth[i]
        if right <= far_u and down <= far_v:
            nearest[pixel] = min(nearest[pixel], z)
        if _ONE - right <= far_u and down <= far_v:
            nearest[pixel + 1] = min(nearest[pixel + 1], z)
        if right <= far_u and _ONE - down <= far_v:
            nearest[pixel + row] = min(nearest[pixel + row], z)
        if _ONE - right <= far_u and _ONE - down <= far_v:
            nearest[pixel + row + 1] = min(nearest[pixel + row + 1], z)


@compiled(contract=True)
def _add(
    u: np.ndarray,
    v: np.ndarray,
    depth: np.ndarray,
    values: np.ndarray,
    span: tuple[int, int],
    frame: tuple[int, int, int],
    nearest: np.ndarray,
    summed: np.ndarray,
) -> None:
    """Add the points' values to the pixels around them, by kernel and depth."""
    row = frame[2] + 2
    pixels = np.zeros(_BLOCK, np.uint32)
    right = np.zeros(_BLOCK, np.float32)
    down = np.zeros(_BLOCK, np.float32)
    block_depth = np.ones(_BLOCK, np.float32)
    weights = np.empty((4, _BLOCK), np.float32)
    rows = np.zeros((_BLOCK, summed.shape[1]), np.float32)
    rows[:, values.shape[1]] = _ONE  # sums the weights
    i = span[0]
    while i < span[1]:
        filled = 0
        while i < span[1] and filled < _BLOCK:
            if _touches(u[i], v[i], frame):
                pixels[filled], right[filled], down[filled] = _place(u[i], v[i], frame)
                block_depth[filled] = depth[i]
                for c in range(values.shape[1]):
                    rows[filled, c] = values[i, c]
                filled += 1
            i += 1
        _weigh(pixels, right, down, block_depth, row, nearest, weights)
        _add_block(pixels, weights, rows, filled, row, summed)


@compiled(contract=True)
def _weigh(
    pixels: np.ndarray,
    right: np.ndarray,
    down: np.ndarray,
    depth: np.ndarray,
    row: int,
    nearest: np.ndarray,
    weights: np.ndarray,
) -> None:
    """Weights of a block of points in the four pixels around each.

    Always of a whole block, so that always the same vector instructions round in the same way;
    in short loops over few arrays, so that there are any. exp(−x) is a polynomial on ±ln 2 / 2
    (to 2·10⁻⁶) times a power of two, whose bits are written down.
    """
    x = np.empty(_BLOCK, np.float32)
    bits = np.empty(_BLOCK, np.int32)
    powers = bits.view(np.float32)
    for corner in range(4):
        to_u, to_v = np.float32(corner % 2), np.float32(corner // 2)
        step = np.uint32(corner // 2 * row + corner % 2)
        for i in range(_BLOCK):
            x[i] = nearest[pixels[i] + step]
        for i in range(_BLOCK):
            exponent = _SHARPNESS * (abs(depth[i] - x[i]) / x[i])
            x[i] = exponent if exponent < _NEGLIGIBLE else _INFINITE  # NaN, too: nothing nearest
        for i in range(_BLOCK):
            halvings = np.int32(x[i] * _PER_LN2 + _HALF)
            bits[i] = (127 - halvings) << 23
            rest = np.float32(halvings) * _LN2 - x[i]
            x[i] = _ONE + rest * (
                _ONE + rest * (_HALF + rest * (_SIXTH + rest * (_24TH + rest * _120TH)))
            )
        for i in range(_BLOCK):
            kernel = (_ONE - abs(right[i] - to_u)) * (_ONE - abs(down[i] - to_v))
            weights[corner, i] = kernel * x[i] * powers[i]


@compiled(contract=True)
def _add_block(
    pixels: np.ndarray,
    weights: np.ndarray,
    rows: np.ndarray,
    filled: int,
    row: int,
    summed: np.ndarray,
) -> None:
    for i in range(filled):
        for corner in range(4):
            weight = weights[corner, i]
            if weight > 0:
                pixel = pixels[i] + np.uint32(corner // 2 * row + corner % 2)
                for first in range(0, rows.shape[1], _LANES):
                    into, values = summed[pixel, first:], rows[i, first:]
                    for lane in range(_LANES):
                        into[lane] += weight * values[lane]


@compiled()
def _write_means(summed: np.ndarray, top: int, bottom: int, means: np.ndarray) -> None:
    """Divide by the weight, and leave the margin behind."""
    channels, _, width = means.shape
    for y in range(top, bottom):
        first = (y - top + 1) * (width + 2) + 1
        for x in range(width):
            weight = summed[first + x, channels - 1]
            share = _ONE / weight if weight > 0 else _ONE
            for c in range(channels - 1):
                means[c, y, x] = summed[first + x, c] * share
            means[channels - 1, y, x] = weight


@compiled()
def _touches(u: float, v: float, frame: tuple[int, int, int]) -> bool:
    """Whether a point lies within a pixel of the rows and columns; false for NaN, too."""
    top, bottom, width = frame
    in_rows = np.float32(top) - _HALF <= v < np.float32(bottom) + _HALF
    return bool(in_rows and -_HALF <= u < np.float32(width) + _HALF)


@compiled()
def _place(
    u: float, v: float, frame: tuple[int, int, int]
) -> tuple[np.uint32, np.floating, np.floating]:
    """The frame's pixel whose centre lies up left of a point, and how far the point is from it."""
    top, _, width = frame
    left, above = np.float32(math.floor(u - _HALF)), np.float32(math.floor(v - _HALF))
    pixel = np.uint32((np.int64(above) - top + 1) * (width + 2) + np.int64(left) + 1)
    return pixel, u - _HALF - left, v - _HALF - above


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
