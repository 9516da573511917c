"""Blending sorted ellipses tile by tile: compiled loops, parallel over tiles."""

import numba
import numpy as np

from extrap_train.gaussians.block_numba import (
    ACROSS,
    BATCH,
    BLOCKS,
    COLORS,
    END,
    LANES,
    LEFT,
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
    PRECISION,
    PRECISION_V,
    SLOPE,
)
from extrap_train.gaussians.tiles_numba import TILE
from extrap_train.geometry.compiled import compiled

_LEAST_LIGHT = np.float32(1e-4)
"""A pixel is full when the next ellipse would leave less light than this."""


@compiled(parallel=True, contract=True)
def blend(
    packed: np.ndarray,
    background: np.ndarray,
    starts: np.ndarray,
    gaussians: np.ndarray,
    image: np.ndarray,
    transmittance: np.ndarray,
    ends: np.ndarray,
) -> None:
    """Fill the last three: up to four channels (h w d), the light that is left, and the number of
    the tile's last meeting that counts, from 1."""
    columns = -(-image.shape[1] // TILE)
    for tile in numba.prange(len(starts) - 1):
        top, left = tile // columns * TILE, tile % columns * TILE
        planes = np.zeros(PLANES * PIXELS, packed.dtype)
        for y in range(min(TILE, len(image) - top)):
            for x in range(min(TILE, image.shape[1] - left)):
                pixel = pixel_of(y, x)
                planes[LIGHT + pixel] = planes[LEFT + pixel] = ONE
        _blend_tile(packed, gaussians[starts[tile] : starts[tile + 1]], top, left, planes)
        for y in range(min(TILE, len(image) - top)):
            for x in range(min(TILE, image.shape[1] - left)):
                pixel = pixel_of(y, x)
                light = planes[LEFT + pixel]
                transmittance[top + y, left + x] = light
                ends[top + y, left + x] = np.int32(planes[END + pixel])
                for c in range(image.shape[2]):
                    color = planes[COLORS + c * PIXELS + pixel]
                    image[top + y, left + x, c] = color + light * background[c]


@compiled(contract=True)
def _blend_tile(
    packed: np.ndarray, gaussians: np.ndarray, top: int, left: int, planes: np.ndarray
) -> None:
    alive = np.ones(BLOCKS, np.bool_)
    batch = np.empty((BATCH, COLUMNS), packed.dtype)
    for start in range(0, len(gaussians), BATCH):
        end = min(start + BATCH, len(gaussians))
        gather(packed, gaussians[start:end], batch)
        for k in range(start, end):
            ellipse = batch[k - start]
            u, v, (first, last, top_row, bottom_row) = place(ellipse, top, left)
            for row in range(top_row, bottom_row):
                for column in range(first, last):
                    block = row * ACROSS + column
                    if alive[block]:
                        center = (u - column * SIDE, v - row * SIDE)
                        _blend_block(planes[block * LANES :], ellipse, center, k + 1)
        if not _find_alive(planes, alive):
            return


@compiled(contract=True)
def _blend_block(
    pixels: np.ndarray, ellipse: np.ndarray, center: tuple[float, float], meeting: int
) -> None:
    """Blend an ellipse, whose mean is given from the block's first pixel on, into the block."""
    u, v, number = pixels.dtype.type(center[0]), pixels.dtype.type(center[1]), np.float32(meeting)
    precision, slope = ellipse[PRECISION], ellipse[SLOPE]
    precision_v, log = ellipse[PRECISION_V], ellipse[LOG_OPACITY]
    first, second = ellipse[FEATURES], ellipse[FEATURES + 1]
    third, fourth = ellipse[FEATURES + 2], ellipse[FEATURES + 3]
    for j in range(LANES):
        down = np.float32(j >> SIDE_BITS) - v
        apart = np.float32(j & (SIDE - 1)) - u - slope * down
        free = alpha_of(log - precision_v * (down * down) - precision * (apart * apart))
        alpha = min(free, MOST_ALPHA)
        light = pixels[LIGHT + j]
        after = light * (ONE - alpha)
        full = after <= _LEAST_LIGHT
        weight = ZERO if full else alpha * light
        pixels[LIGHT + j] = ZERO if full else after
        pixels[LEFT + j] = pixels[LEFT + j] if full else after
        pixels[END + j] = number if weight > ZERO else pixels[END + j]
        pixels[COLORS + j] += weight * first
        pixels[COLORS + PIXELS + j] += weight * second
        pixels[COLORS + 2 * PIXELS + j] += weight * third
        pixels[COLORS + 3 * PIXELS + j] += weight * fourth


@compiled()
def _find_alive(planes: np.ndarray, alive: np.ndarray) -> bool:
    """Mark the blocks that any light passes through, and say whether there are any."""
    some = False
    for block in range(len(alive)):
        light = ZERO
        for j in range(LANES):
            light = max(light, planes[LIGHT + block * LANES + j])
        alive[block] = light > ZERO
        some = some or alive[block]
    return some
