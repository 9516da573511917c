"""Softmax splatting on the CPU: every thread owns a band of rows, so no atomics and the same bits on any count."""

import math

import numba
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from extrap_train.geometry.splat_kernel import DEPTH_SHARPNESS, LEAST_KERNEL

LANES = 8
"""Channels are padded to a multiple of this, so that a point is added with whole vector instructions."""
_SHARPNESS = np.float32(DEPTH_SHARPNESS)
_LEAST = np.float32(LEAST_KERNEL)
_LARGEST_EXPONENT = np.float32(60.0)


def splat_pixels_numba(
    u: Float[Tensor, "n"],
    v: Float[Tensor, "n"],
    depth: Float[Tensor, "n"],
    image: Int[Tensor, "n"],
    values: Float[Tensor, "n c"],
    size: tuple[int, int, int],
) -> Float[Tensor, "b h w c1"]:
    """Weighted sums of the values, and the summed weight as the last channel, for `size` = (b, h, w)."""
    b, h, w = size
    channels = values.shape[1]
    padded = values.new_zeros(len(values), -(-(channels + 1) // LANES) * LANES)
    padded[:, :channels] = values
    padded[:, channels] = 1
    starts = torch.searchsorted(image.contiguous(), torch.arange(b + 1, device=image.device))
    summed = torch.zeros(b, h, w, padded.shape[1])
    arrays = [x.detach().contiguous().numpy() for x in (u, v, depth, padded, starts)]
    bands = -(-numba.get_num_threads() // b)
    _splat(*arrays, bands, summed.numpy())
    return summed[..., : channels + 1]


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _splat(u, v, depth, values, starts, bands, summed):  # noqa: ANN001, ANN202
    images, height, width, _ = summed.shape
    nearest = np.full((images, height, width), np.float32(np.inf), np.float32)
    for task in numba.prange(images * bands):
        image, band = task // bands, task % bands
        top, bottom = height * band // bands, height * (band + 1) // bands
        first, last = starts[image], starts[image + 1]
        _nearest_in_band(u, v, depth, first, last, top, bottom, nearest[image])
        _add_in_band(u, v, depth, values, first, last, top, bottom, nearest[image], summed[image])


@numba.njit(cache=True, error_model="numpy")
def _nearest_in_band(u, v, depth, first, last, top, bottom, nearest):  # noqa: ANN001, ANN202
    width = nearest.shape[1]
    for i in range(first, last):
        y, down = _split(v[i])
        if y < top - 1 or y >= bottom:
            continue
        x, right = _split(u[i])
        for dy in range(2):
            if not top <= y + dy < bottom:
                continue
            kernel_y = down if dy else np.float32(1) - down
            for dx in range(2):
                kernel = (right if dx else np.float32(1) - right) * kernel_y
                if 0 <= x + dx < width and kernel >= _LEAST:
                    nearest[y + dy, x + dx] = min(nearest[y + dy, x + dx], depth[i])


@numba.njit(cache=True, error_model="numpy")
def _add_in_band(u, v, depth, values, first, last, top, bottom, nearest, summed):  # noqa: ANN001, ANN202
    width, lanes = summed.shape[1], summed.shape[2]
    for i in range(first, last):
        y, down = _split(v[i])
        if y < top - 1 or y >= bottom:
            continue
        x, right = _split(u[i])
        for dy in range(2):
            if not top <= y + dy < bottom:
                continue
            kernel_y = down if dy else np.float32(1) - down
            for dx in range(2):
                kernel = (right if dx else np.float32(1) - right) * kernel_y
                if not (0 <= x + dx < width and kernel >= _LEAST):
                    continue
                least = nearest[y + dy, x + dx]
                exponent = _SHARPNESS * ((depth[i] - least) / least)
                if exponent > _LARGEST_EXPONENT:
                    continue
                weight = kernel * _exp_minus(exponent)
                for start in range(0, lanes, LANES):
                    for lane in range(LANES):
                        summed[y + dy, x + dx, start + lane] += weight * values[i, start + lane]


@numba.njit(cache=True, inline="always")
def _split(position):  # noqa: ANN001, ANN202
    """Whole and fractional part of a coordinate, counted from pixel centres."""
    shifted = position - np.float32(0.5)
    whole = math.floor(shifted)
    return int(whole), shifted - np.float32(whole)


@numba.njit(cache=True, inline="always")
def _exp_minus(x):  # noqa: ANN001, ANN202
    return np.float32(math.exp(-x))
