"""The derivative of blending: compiled loops, parallel over tiles.

Each tile's ellipses are walked back to front. Per meeting of an ellipse with a tile, moments of the
gradient are summed and written to the meeting's own slot; the slots of an ellipse are then added in
a fixed order. Nothing is added by two threads, so the same bits come out on any number of them.
"""

import numba
import numpy as np

from extrap_train.gaussians.block_numba import (
    ACROSS,
    BATCH,
    BEHIND,
    BLOCKS,
    COLORS,
    END,
    LANES,
    LIGHT,
    MOST_ALPHA,
    ONE,
    PIXELS,
    PLANES,
    SIDE,
    SIDE_BITS,
    ZERO,
    alpha_of,
    gather,
    pixel_of,
    place,
)
from extrap_train.gaussians.packed_numba import (
    COLUMNS,
    FEATURES,
    LOG_OPACITY,
    MOMENTS,
    PRECISION,
    PRECISION_V,
    SLOPE,
)
from extrap_train.gaussians.tiles_numba import TILE
from extrap_train.geometry.compiled import compiled


@compiled(parallel=True, contract=True)
def blend_backward(
    packed: np.ndarray,
    background: np.ndarray,
    starts: np.ndarray,
    gaussians: np.ndarray,
    slots: np.ndarray,
    transmittance: np.ndarray,
    ends: np.ndarray,
    image_grad: np.ndarray,
    transmittance_grad: np.ndarray,
    moments: np.ndarray,
) -> None:
    """Fill the slots with the moments (slots MOMENTS) of each meeting."""
    height, width, channels = image_grad.shape
    columns = -(-width // TILE)
    for tile in numba.prange(len(starts) - 1):
        top, left = tile // columns * TILE, tile % columns * TILE
        planes = np.zeros(PLANES * PIXELS, packed.dtype)
        for y in range(min(TILE, height - top)):
            for x in range(min(TILE, width - left)):
                pixel, light = pixel_of(y, x), transmittance[top + y, left + x]
                behind = transmittance_grad[top + y, left + x]
                for c in range(channels):
                    grad = image_grad[top + y, left + x, c]
                    planes[COLORS + c * PIXELS + pixel] = grad
                    behind += background[c] * grad
                planes[LIGHT + pixel], planes[BEHIND + pixel] = light, behind * light
                planes[END + pixel] = ends[top + y, left + x]
        meetings = slice(starts[tile], starts[tile + 1])
        _tile_backward(packed, gaussians[meetings], slots[meetings], top, left, planes, moments)


@compiled(contract=True)
def _tile_backward(
    packed: np.ndarray,
    gaussians: np.ndarray,
    slots: np.ndarray,
    top: int,
    left: int,
    planes: np.ndarray,
    moments: np.ndarray,
) -> None:
    ends = np.zeros(BLOCKS, np.int64)
    for pixel in range(PIXELS):
        block = pixel // LANES
        ends[block] = max(ends[block], np.int64(planes[END + pixel]))
    end = ends.max()
    for k in range(end, len(slots)):
        moments[slots[k]] = 0
    sums = np.empty(MOMENTS * LANES, packed.dtype)
    batch = np.empty((BATCH, COLUMNS), packed.dtype)
    for stop in range(end, 0, -BATCH):
        start = max(stop - BATCH, 0)
        gather(packed, gaussians[start:stop], batch)
        for k in range(stop - 1, start - 1, -1):
            sums[:] = 0
            ellipse = batch[k - start]
            u, v, (first, last, top_row, bottom_row) = place(ellipse, top, left)
            for row in range(top_row, bottom_row):
                for column in range(first, last):
                    block = row * ACROSS + column
                    if k < ends[block]:
                        center = (u - column * SIDE, v - row * SIDE)
                        _block_backward(planes[block * LANES :], ellipse, center, k + 1, sums)
            _add_lanes(sums, moments[slots[k]])


@compiled(contract=True)
def _block_backward(
    pixels: np.ndarray,
    ellipse: np.ndarray,
    center: tuple[float, float],
    meeting: int,
    sums: np.ndarray,
) -> None:
    """Take an ellipse off a block, and add what the gradients of the pixels say."""
    u, v, number = pixels.dtype.type(center[0]), pixels.dtype.type(center[1]), np.float32(meeting)
    precision, slope = ellipse[PRECISION], ellipse[SLOPE]
    precision_v, log = ellipse[PRECISION_V], ellipse[LOG_OPACITY]
    first, second = ellipse[FEATURES], ellipse[FEATURES + 1]
    third, fourth = ellipse[FEATURES + 2], ellipse[FEATURES + 3]
    for j in range(LANES):
        down = np.float32(j >> SIDE_BITS) - v
        apart = np.float32(j & (SIDE - 1)) - u - slope * down
        free = alpha_of(log - precision_v * (down * down) - precision * (apart * apart))
        free = free if pixels[END + j] >= number else ZERO
        alpha = min(free, MOST_ALPHA)
        share = ONE / (ONE - alpha)
        light = pixels[LIGHT + j] * share
        weight = alpha * light
        one, two = pixels[COLORS + j], pixels[COLORS + PIXELS + j]
        three, four = pixels[COLORS + 2 * PIXELS + j], pixels[COLORS + 3 * PIXELS + j]
        value = first * one + second * two + third * three + fourth * four
        behind = pixels[BEHIND + j]
        grad = weight * value - alpha * share * behind
        grad = grad if free <= MOST_ALPHA else ZERO
        pixels[LIGHT + j] = light
        pixels[BEHIND + j] = behind + weight * value
        across = grad * apart
        sums[j] += grad
        sums[LANES + j] += grad * down
        sums[2 * LANES + j] += grad * (down * down)
        sums[3 * LANES + j] += across
        sums[4 * LANES + j] += across * down
        sums[5 * LANES + j] += across * apart
        sums[6 * LANES + j] += weight * one
        sums[7 * LANES + j] += weight * two
        sums[8 * LANES + j] += weight * three
        sums[9 * LANES + j] += weight * four


@compiled()
def _add_lanes(sums: np.ndarray, moments: np.ndarray) -> None:
    """Sum the lanes of each moment, halves first; `sums` is used up."""
    for i in range(MOMENTS):
        lanes = sums[i * LANES : (i + 1) * LANES]
        for j in range(LANES // 2):
            lanes[j] += lanes[j + LANES // 2]
        for j in range(LANES // 4):
            lanes[j] += lanes[j + LANES // 4]
        moments[i] = (lanes[0] + lanes[2]) + (lanes[1] + lanes[3])
