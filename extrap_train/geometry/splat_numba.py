"""Softmax splatting on the CPU: every thread owns a band of rows, so no atomics and the same bits on any count."""

import math

import numba
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.geometry.splat_kernel import DEPTH_SHARPNESS, ScreenPoints

LANES = 8
"""Channels are padded to a multiple of this, so that a point is added with whole vector instructions."""
_ONE = np.float32(1)
_HALF = np.float32(0.5)
_SHARPNESS = np.float32(DEPTH_SHARPNESS)
_NEGLIGIBLE = np.float32(60.0)


def splat_pixels_numba(
    points: ScreenPoints, values: Float[Tensor, "n c"], size: tuple[int, int, int]
) -> Float[Tensor, "b h w c1"]:
    """Weighted sums of the values, and the summed weight as the last channel, for `size` = (b, h, w)."""
    images, height, width = size
    channels = values.shape[1]
    padded = values.new_empty(len(values), -(-(channels + 1) // LANES) * LANES)
    padded[:, :channels] = values
    padded[:, channels] = 1
    padded[:, channels + 1 :] = 0
    starts = torch.searchsorted(points.image, torch.arange(images + 1))
    columns = (points.u, points.v, points.depth, points.reach_u, points.reach_v, padded, starts)
    summed = torch.zeros(images, height, width, padded.shape[1])
    bands = -(-numba.get_num_threads() // images)
    _splat(*(x.detach().contiguous().numpy() for x in columns), bands, summed.numpy())
    return summed[..., : channels + 1]


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _splat(u, v, depth, reach_u, reach_v, values, starts, bands, summed):  # noqa: ANN001, ANN202
    images, height, width, _ = summed.shape
    nearest = np.full((images, height, width), np.float32(np.inf), np.float32)
    for task in numba.prange(images * bands):
        image, band = task // bands, task % bands
        rows = (height * band // bands, height * (band + 1) // bands)
        span = (starts[image], starts[image + 1])
        _find_nearest(u, v, depth, reach_u, reach_v, span, rows, nearest[image])
        _add(u, v, depth, values, span, rows, nearest[image], summed[image])


@numba.njit(cache=True, error_model="numpy")
def _find_nearest(u, v, depth, reach_u, reach_v, span, rows, nearest):  # noqa: ANN001, ANN202
    """Least depth of the points that reach each pixel's centre."""
    top, bottom = rows
    width = nearest.shape[1]
    for i in range(span[0], span[1]):
        y, down = _split(v[i])
        if y < top - 1 or y >= bottom:
            continue
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


@numba.njit(cache=True, error_model="numpy")
def _add(u, v, depth, values, span, rows, nearest, summed):  # noqa: ANN001, ANN202
    """Add the points' values to the pixels around them, by kernel and depth."""
    top, bottom = rows
    width, lanes = summed.shape[1], summed.shape[2]
    for i in range(span[0], span[1]):
        y, down = _split(v[i])
        if y < top - 1 or y >= bottom:
            continue
        x, right = _split(u[i])
        for dy in range(2):
            if not top <= y + dy < bottom:
                continue
            kernel_y = down if dy else _ONE - down
            for dx in range(2):
                if not 0 <= x + dx < width:
                    continue
                least = nearest[y + dy, x + dx]
                exponent = _SHARPNESS * (abs(depth[i] - least) / least)
                if not exponent < _NEGLIGIBLE:
                    continue
                kernel_x = right if dx else _ONE - right
                weight = kernel_x * kernel_y * np.float32(math.exp(-exponent))
                for start in range(0, lanes, LANES):
                    for lane in range(LANES):
                        summed[y + dy, x + dx, start + lane] += weight * values[i, start + lane]


@numba.njit(cache=True, error_model="numpy")
def _split(position):  # noqa: ANN001, ANN202
    """Whole and fractional part of a coordinate, counted from pixel centres."""
    shifted = position - _HALF
    whole = np.float32(math.floor(shifted))
    return int(whole), shifted - whole
