"""Softmax splatting on the CPU: every thread draws a band of rows, so there are no atomics, and
the same bits come out on any number of them.

A band is drawn into a frame of its own with a margin of one pixel, so that nothing in the inner
loops asks where the image ends; what falls into the margin belongs to a neighbouring band.
"""

import math

import numba
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from extrap_train.geometry.compiled import compiled
from extrap_train.geometry.warp.splat import DEPTH_SHARPNESS, OUTSIDE

_HALF, _ONE, _INFINITY = (np.float32(x) for x in (0.5, 1, np.inf))
_OUTSIDE = np.float32(OUTSIDE)
_SHARPNESS = np.float32(DEPTH_SHARPNESS)
_NEGLIGIBLE = np.float32(60.0)
"""Exponent from which on a point weighs nothing."""
_BELOW_ONE = np.nextafter(_ONE, np.float32(0))
"""A pixel's centre at a distance of one whole pixel is out of the kernel's reach."""
_WEIGHTLESS = np.float32(127 * math.log(2))
"""Exponent that stands for no weight at all: 2⁻¹²⁷ is written with no bits."""
_LN2, _PER_LN2 = np.float32(math.log(2)), np.float32(1 / math.log(2))
_SIXTH, _24TH, _120TH = (np.float32(1 / math.factorial(n)) for n in (3, 4, 5))
_LANES = 8
"""Values are added in vectors of this length."""
_BLOCK = 64
"""Points whose weights are computed at a time."""


def splat_numba(
    points: Float[np.ndarray, "3 n"],
    reach: Float[np.ndarray, "2 n"] | Float[np.ndarray, "2 1"],
    values: Float[np.ndarray, "n c"],
    spans: Int[np.ndarray, "b m 2"],
    height: int,
    width: int,
) -> Float[Tensor, "b c1 h w"]:
    """Weighted means of the values, and the summed weight as the last channel.

    Points are u, v and depth, with their reach along u and v (or that of all of them), as in
    `splat.ScreenPoints`; those of an image are the ones from the first up to the second
    index of each of its spans.
    """
    images = len(spans)
    means = torch.empty(images, values.shape[1] + 1, height, width)
    bands = -(-numba.get_num_threads() // images)
    _splat(points, reach, values, spans, bands, means.numpy())
    return means


@compiled(parallel=True)
def _splat(points, reach, values, spans, bands, means):
    height = means.shape[2]
    for task in numba.prange(len(spans) * bands):
        image, band = task // bands, task % bands
        rows = (height * band // bands, height * (band + 1) // bands)
        _draw_band(points, reach, values, spans[image], rows, means[image])


@compiled()
def _draw_band(points, reach, values, spans, rows, means):
    channels, _, width = means.shape
    frame = (rows[0], rows[1], width)
    pixels = (rows[1] - rows[0] + 2) * (width + 2)
    nearest = np.full(pixels, _INFINITY, np.float32)
    summed = np.zeros((pixels, -(-channels // _LANES) * _LANES), np.float32)
    _find_nearest(points, reach, spans, frame, nearest)
    _add(points, values, spans, frame, nearest, summed)
    _write_means(summed, frame, means)


@compiled()
def _find_nearest(points, reach, spans, frame, nearest):
    """Least depth of the points that reach each pixel's centre."""
    u, v, depth = points
    row, each = frame[2] + 2, reach.shape[1] > 1
    for span in range(len(spans)):
        for i in range(spans[span, 0], spans[span, 1]):
            if not _touches(u[i], v[i], frame):
                continue
            pixel, right, down = _place(u[i], v[i], frame)
            far_u = min(reach[0, i if each else 0], _BELOW_ONE)
            far_v = min(reach[1, i if each else 0], _BELOW_ONE)
            for corner in range(4):
                apart_u = _ONE - right if corner % 2 else right
                apart_v = _ONE - down if corner // 2 else down
                reached = (apart_u <= far_u) & (apart_v <= far_v)
                at = pixel + np.uint32(corner // 2 * row + corner % 2)
                claim = depth[i] if reached else _INFINITY  # no branch: nobody could predict it
                nearest[at] = min(nearest[at], claim)


@compiled(contract=True)
def _add(points, values, spans, frame, nearest, summed):
    """Add the points' values to the pixels around them, by kernel and depth, block by block."""
    row, channels = frame[2] + 2, values.shape[1]
    pixels = np.zeros(_BLOCK, np.uint32)
    right = np.zeros(_BLOCK, np.float32)
    down = np.zeros(_BLOCK, np.float32)
    depth = np.ones(_BLOCK, np.float32)
    weights = np.empty((4, _BLOCK), np.float32)
    lanes = np.zeros((_BLOCK, summed.shape[1]), np.float32)
    lanes[:, channels] = _ONE  # sums the weights
    span, i = 0, spans[0, 0]
    while span < len(spans):
        filled = 0
        while span < len(spans) and filled < _BLOCK:
            if i == spans[span, 1]:
                span += 1
                i = spans[span, 0] if span < len(spans) else i
                continue
            if _touches(points[0, i], points[1, i], frame):
                place = _place(points[0, i], points[1, i], frame)
                pixels[filled], right[filled], down[filled] = place
                depth[filled] = points[2, i]
                for c in range(channels):
                    lanes[filled, c] = values[i, c]
                filled += 1
            i += 1
        _weigh(pixels, right, down, depth, row, nearest, weights)
        _add_block(pixels, weights, lanes, filled, row, summed)


@compiled(contract=True)
def _weigh(pixels, right, down, depth, row, nearest, weights):
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
            x[i] = exponent if exponent < _NEGLIGIBLE else _WEIGHTLESS  # NaN, too: nothing nearest
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
def _add_block(pixels, weights, lanes, filled, row, summed):
    for i in range(filled):
        for corner in range(4):
            weight = weights[corner, i]
            if weight > 0:
                pixel = pixels[i] + np.uint32(corner // 2 * row + corner % 2)
                for first in range(0, lanes.shape[1], _LANES):
                    into, values = summed[pixel, first:], lanes[i, first:]
                    for lane in range(_LANES):
                        into[lane] += weight * values[lane]


@compiled()
def _write_means(summed, frame, means):
    """Divide by the weight, and leave the margin behind."""
    channels = len(means)
    top, bottom, width = frame
    for y in range(top, bottom):
        first = (y - top + 1) * (width + 2) + 1
        for x in range(width):
            weight = summed[first + x, channels - 1]
            share = _ONE / weight if weight > 0 else _ONE
            for c in range(channels - 1):
                means[c, y, x] = summed[first + x, c] * share
            means[channels - 1, y, x] = weight


@compiled()
def _touches(u, v, frame):
    """Whether a point lies within a pixel of the rows and columns; false for NaN, too."""
    top, bottom, width = frame
    in_rows = np.float32(top) - _HALF <= v < np.float32(bottom) + _HALF
    return bool(in_rows and -_HALF <= u < np.float32(width) + _HALF)


@compiled()
def _place(u, v, frame):
    """The frame's pixel whose centre lies up left of a point, and how far the point is from it."""
    top, _, width = frame
    left, above = np.float32(math.floor(u - _HALF)), np.float32(math.floor(v - _HALF))
    pixel = np.uint32((np.int64(above) - top + 1) * (width + 2) + np.int64(left) + 1)
    return pixel, u - _HALF - left, v - _HALF - above


def project_numba(
    world_points: Float[Tensor, "n 3"], pixels_from_world: Float[Tensor, "3 4"]
) -> Float[np.ndarray, "3 n"]:
    """Pixel u, v and depth; points at or behind the camera land outside every image."""
    points = np.empty((3, len(world_points)), np.float32)
    _project(
        world_points.detach().contiguous().numpy(),
        pixels_from_world.detach().contiguous().numpy(),
        points,
    )
    return points


@compiled(parallel=True)
def _project(world, m, points):
    for i in numba.prange(len(world)):
        x, y, z = world[i, 0], world[i, 1], world[i, 2]
        depth = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
        if depth > 0:
            points[0, i] = (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]) / depth
            points[1, i] = (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]) / depth
            points[2, i] = depth
        else:
            points[0, i], points[1, i], points[2, i] = _OUTSIDE, _OUTSIDE, _ONE
