"""A tile of the image as blending holds it: planes of one small array, in blocks of 4×4 pixels.

The innermost loops run over a block's pixels and have no branches, so that the compiler makes
vector instructions of them. Powers of two are polynomials: every exponent lies between log₂(1/255)
and 0.
"""

import math

import numpy as np

from extrap_train.gaussians.packed_numba import (
    CHANNELS,
    COLUMNS,
    LEAST_LOG,
    REACH,
    U,
    V,
)
from extrap_train.gaussians.tiles_numba import TILE
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
is left at the end, or what lies behind as the loss sees it; the last meeting that counts, from 1;
four colours, or their gradients. A tile's planes hold numbers of one type."""
PLANES = 3 + CHANNELS
BATCH = 16
"""Ellipses that are fetched together, so that their cache misses overlap."""

ZERO, ONE = np.float32(0), np.float32(1)
MOST_ALPHA = np.float32(0.999)
_QUARTER = np.float32(0.25)


def _power_of_two() -> list[np.float32]:
    """Coefficients of a polynomial that is 2ˣ on [−2, 0] to 2·10⁻⁸."""
    fit = np.polynomial.Chebyshev.interpolate(np.exp2, 7, domain=[-2, 0])
    return [np.float32(c) for c in fit.convert(kind=np.polynomial.Polynomial).coef]


_P0, _P1, _P2, _P3, _P4, _P5, _P6, _P7 = _power_of_two()


@compiled(contract=True)
def alpha_of(log_alpha: np.floating) -> np.floating:
    """2 to that power, and zero where it is below 1/255; at most 1."""
    x = np.minimum(np.maximum(log_alpha, LEAST_LOG), ZERO) * _QUARTER
    low = _P0 + x * (_P1 + x * (_P2 + x * _P3))
    high = _P4 + x * (_P5 + x * (_P6 + x * _P7))
    square = x * x
    root = low + square * square * high
    root *= root
    return root * root if log_alpha >= LEAST_LOG else ZERO


@compiled(contract=True)
def place(
    ellipse: np.ndarray, top: int, left: int
) -> tuple[float, float, tuple[int, int, int, int]]:
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
def pixel_of(y: int, x: int) -> int:
    """Where a tile's pixel lies in a plane."""
    block = y // SIDE * ACROSS + x // SIDE
    return block * LANES + y % SIDE * SIDE + x % SIDE


@compiled()
def gather(packed: np.ndarray, gaussians: np.ndarray, batch: np.ndarray) -> None:
    """Copy the ellipses of a batch."""
    for k in range(len(gaussians)):
        for c in range(COLUMNS):
            batch[k, c] = packed[gaussians[k], c]
