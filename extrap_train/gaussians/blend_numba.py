"""Blending sorted ellipses tile by tile, and its derivative: compiled loops, parallel over tiles.

A tile is held as planes of one small array, in blocks of 4×4 pixels. The innermost loops run over a
block's pixels and have no branches, so that the compiler makes vector instructions of them. Powers
of two are polynomials: every exponent lies between log₂(1/255) and 0.

The derivative walks each tile's ellipses back to front. Per overlap of an ellipse with a tile,
moments of the gradient are summed and written to the overlap's own slot; the slots of an ellipse
are then added in a fixed order. Nothing is added by two threads, so the same bits come out on any
number of them.
"""

import math

import numba
import numpy as np

from extrap_train.gaussians.tiles_numba import (
    CHANNELS,
    COLUMNS,
    FEATURES,
    LOG_OPACITY,
    MIN_LOG,
    MOMENTS,
    PRECISION,
    PRECISION_V,
    REACH,
    SLOPE,
    TILE,
    U,
    V,
)
from extrap_train.geometry.compiled import compiled

PIXELS = TILE * TILE
SIDE = 4
SIDE_BITS = 2
LANES = SIDE * SIDE
"""Pixels of a block, row by row: as many as make the compiler use vectors."""
ACROSS = TILE // SIDE
BLOCKS = ACROSS * ACROSS
LIGHT, LEFT, BEHIND, END, COLORS = 0, PIXELS, PIXELS, 2 * PIXELS, 3 * PIXELS
"""Planes of a tile, block by block. Light that is under way (0 once the pixel is full); light that
is left at the end, or what lies behind as the loss sees it; the last overlap that counts, from 1;
four colours, or their gradients. A tile's planes hold numbers of one type."""
PLANES = 3 + CHANNELS
BATCH = 16
"""Ellipses that are fetched together, so that their cache misses overlap."""

ZERO, ONE = np.float32(0), np.float32(1)
MAX_ALPHA = np.float32(0.999)
_QUARTER = np.float32(0.25)


def _power_of_two() -> list[np.float32]:
    """Coefficients of a polynomial that is 2ˣ on [−2, 0] to 2·10⁻⁸."""
    fit = np.polynomial.Chebyshev.interpolate(np.exp2, 7, domain=[-2, 0])
    return [np.float32(c) for c in fit.convert(kind=np.polynomial.Polynomial).coef]


_P0, _P1, _P2, _P3, _P4, _P5, _P6, _P7 = _power_of_two()


@compiled(contract=True)
def alpha_of(log_alpha):
    """2 to that power, and zero where it is below 1/255; at most 1."""
    x = np.minimum(np.maximum(log_alpha, MIN_LOG), ZERO) * _QUARTER
    low = _P0 + x * (_P1 + x * (_P2 + x * _P3))
    high = _P4 + x * (_P5 + x * (_P6 + x * _P7))
    square = x * x
    root = low + square * square * high
    root *= root
    return root * root if log_alpha >= MIN_LOG else ZERO


@compiled(contract=True)
def place(ellipse, top, left):
    """The mean in the tile's coordinates (pixel centres whole), and the blocks that it reaches
    there: first and one past the last column, first and one past the last row."""
    u, v = np.float64(ellipse[U]) - left - 0.5, np.float64(ellipse[V]) - top - 0.5
    far_u, far_v = ellipse[REACH], ellipse[REACH + 1]
    first = max(math.ceil(u - far_u), 0) // SIDE
    last = min(math.floor(u + far_u), TILE - 1) // SIDE + 1
    top_row = max(math.ceil(v - far_v), 0) // SIDE
    bottom_row = min(math.floor(v + far_v), TILE - 1) // SIDE + 1
    return u, v, (first, last, top_row, bottom_row)


@compiled()
def pixel_of(y, x):
    """Where a tile's pixel lies in a plane."""
    block = y // SIDE * ACROSS + x // SIDE
    return block * LANES + y % SIDE * SIDE + x % SIDE


@compiled()
def gather(packed, gaussians, batch):
    """Copy the ellipses of a batch."""
    for k in range(len(gaussians)):
        for c in range(COLUMNS):
            batch[k, c] = packed[gaussians[k], c]


_MIN_LIGHT = np.float32(1e-4)
"""A pixel is full when the next ellipse would leave less light than this."""


@compiled(parallel=True, contract=True)
def blend(packed, background, starts, gaussians, image, transmittance, ends):
    """Fill the last three: up to four channels (h w d), the light that is left, and the number of
    the tile's last overlap that counts, from 1."""
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
def _blend_tile(packed, gaussians, top, left, planes):
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
def _blend_block(pixels, ellipse, center, overlap):
    """Blend an ellipse into the block; `center` is its mean relative to the first pixel."""
    u, v, number = pixels.dtype.type(center[0]), pixels.dtype.type(center[1]), np.float32(overlap)
    precision, slope = ellipse[PRECISION], ellipse[SLOPE]
    precision_v, log = ellipse[PRECISION_V], ellipse[LOG_OPACITY]
    first, second = ellipse[FEATURES], ellipse[FEATURES + 1]
    third, fourth = ellipse[FEATURES + 2], ellipse[FEATURES + 3]
    for j in range(LANES):
        down = np.float32(j >> SIDE_BITS) - v
        apart = np.float32(j & (SIDE - 1)) - u - slope * down
        free = alpha_of(log - precision_v * (down * down) - precision * (apart * apart))
        alpha = min(free, MAX_ALPHA)
        light = pixels[LIGHT + j]
        after = light * (ONE - alpha)
        full = after <= _MIN_LIGHT
        weight = ZERO if full else alpha * light
        pixels[LIGHT + j] = ZERO if full else after
        pixels[LEFT + j] = pixels[LEFT + j] if full else after
        pixels[END + j] = number if weight > ZERO else pixels[END + j]
        pixels[COLORS + j] += weight * first
        pixels[COLORS + PIXELS + j] += weight * second
        pixels[COLORS + 2 * PIXELS + j] += weight * third
        pixels[COLORS + 3 * PIXELS + j] += weight * fourth


@compiled()
def _find_alive(planes, alive):
    """Mark the blocks that any light passes through, and say whether there are any."""
    some = False
    for block in range(len(alive)):
        light = ZERO
        for j in range(LANES):
            light = max(light, planes[LIGHT + block * LANES + j])
        alive[block] = light > ZERO
        some = some or alive[block]
    return some


@compiled(parallel=True, contract=True)
def blend_backward(
    packed,
    background,
    starts,
    gaussians,
    slots,
    transmittance,
    ends,
    image_grad,
    transmittance_grad,
    moments,
):
    """Fill the slots with the moments (slots MOMENTS) of each overlap."""
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
        overlaps = slice(starts[tile], starts[tile + 1])
        _tile_backward(packed, gaussians[overlaps], slots[overlaps], top, left, planes, moments)


@compiled(contract=True)
def _tile_backward(packed, gaussians, slots, top, left, planes, moments):
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
def _block_backward(pixels, ellipse, center, overlap, sums):
    """Take an ellipse off a block, and add what the gradients of the pixels say."""
    u, v, number = pixels.dtype.type(center[0]), pixels.dtype.type(center[1]), np.float32(overlap)
    precision, slope = ellipse[PRECISION], ellipse[SLOPE]
    precision_v, log = ellipse[PRECISION_V], ellipse[LOG_OPACITY]
    first, second = ellipse[FEATURES], ellipse[FEATURES + 1]
    third, fourth = ellipse[FEATURES + 2], ellipse[FEATURES + 3]
    for j in range(LANES):
        down = np.float32(j >> SIDE_BITS) - v
        apart = np.float32(j & (SIDE - 1)) - u - slope * down
        free = alpha_of(log - precision_v * (down * down) - precision * (apart * apart))
        free = free if pixels[END + j] >= number else ZERO
        alpha = min(free, MAX_ALPHA)
        share = ONE / (ONE - alpha)
        light = pixels[LIGHT + j] * share
        weight = alpha * light
        one, two = pixels[COLORS + j], pixels[COLORS + PIXELS + j]
        three, four = pixels[COLORS + 2 * PIXELS + j], pixels[COLORS + 3 * PIXELS + j]
        value = first * one + second * two + third * three + fourth * four
        behind = pixels[BEHIND + j]
        grad = weight * value - alpha * share * behind
        grad = grad if free <= MAX_ALPHA else ZERO
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
def _add_lanes(sums, moments):
    """Sum the lanes of each moment, halves first; `sums` is used up."""
    for i in range(MOMENTS):
        lanes = sums[i * LANES : (i + 1) * LANES]
        for j in range(LANES // 2):
            lanes[j] += lanes[j + LANES // 2]
        for j in range(LANES // 4):
            lanes[j] += lanes[j + LANES // 4]
        moments[i] = (lanes[0] + lanes[2]) + (lanes[1] + lanes[3])
