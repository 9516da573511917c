"""Ellipses packed for blending and sorted into the image's tiles, nearest first: compiled loops.

Two threads or twenty, the lists come out the same: an entry's place is counted, not claimed.
"""

import math
from typing import NamedTuple

import numba
import numpy as np
from jaxtyping import Float, Int

from extrap_train.gaussians.projection_numba import MIN_ALPHA
from extrap_train.geometry.compiled import compiled

CHANNELS = 4
"""Features that are blended at a time."""
MOMENTS = 6 + CHANNELS
"""What a slot holds: Σg, Σg·dy, Σg·dy², Σg·e, Σg·e·dy, Σg·e², with g the gradient to log alpha, dy
the distance from the mean along y and e that from the centre line along x; then one sum a feature.
"""
COLUMNS = 8 + CHANNELS
U, V, PRECISION, SLOPE, PRECISION_V, LOG_OPACITY, REACH, FEATURES = 0, 1, 2, 3, 4, 5, 6, 8
"""Columns of a packed ellipse; precisions and logarithms are to base 2."""

MIN_LOG = np.float32(math.log2(MIN_ALPHA))
"""No alpha below is blended."""
_HALF_PER_LN2 = np.float32(0.5 / math.log(2))
_ZERO, _HALF = np.float32(0), np.float32(0.5)


@compiled(parallel=True)
def pack(means, shapes, opacities, features, radii, packed):
    """What blending needs of an ellipse, side by side (n COLUMNS), padded with zero features."""
    for i in numba.prange(len(means)):
        packed[i] = 0
        packed[i, REACH] = packed[i, REACH + 1] = -1
        if radii[i, 0] > 0:
            across, down = shapes[i, 0] * _HALF_PER_LN2, shapes[i, 2] * _HALF_PER_LN2
            log = math.log2(opacities[i])
            packed[i, U], packed[i, V], packed[i, LOG_OPACITY] = means[i, 0], means[i, 1], log
            packed[i, PRECISION], packed[i, SLOPE] = across, shapes[i, 1]
            packed[i, PRECISION_V] = down
            span = max(log - MIN_LOG, _ZERO)
            slope = shapes[i, 1]
            packed[i, REACH] = math.sqrt(span * (1 / across + slope * slope / down))
            packed[i, REACH + 1] = math.sqrt(span / down)
            for c in range(features.shape[1]):
                packed[i, FEATURES + c] = features[i, c]


@compiled(parallel=True)
def unpack(
    slot_starts, moments, shapes, opacities, means_grad, shapes_grad, opacities_grad, features_grad
):
    """Add each ellipse's slots, in order, and make gradients of the moments."""
    for i in numba.prange(len(shapes)):
        means_grad[i], shapes_grad[i], opacities_grad[i], features_grad[i] = 0, 0, 0, 0
        for slot in range(slot_starts[i], slot_starts[i + 1]):
            m = moments[slot]
            pull = shapes[i, 0] * m[3]
            means_grad[i, 0] += pull
            means_grad[i, 1] += shapes[i, 2] * m[1] - shapes[i, 1] * pull
            shapes_grad[i, 0] -= _HALF * m[5]
            shapes_grad[i, 1] += shapes[i, 0] * m[4]
            shapes_grad[i, 2] -= _HALF * m[2]
            opacities_grad[i] += m[0] / opacities[i]
            for c in range(features_grad.shape[1]):
                features_grad[i, c] += m[6 + c]


TILE = 16
"""Side of a tile in px."""
_DIGIT_BITS = 11
_DIGITS = 2**_DIGIT_BITS
"""Depths are sorted by three digits of this size."""


class Tiles(NamedTuple):
    """Every overlap of an ellipse with a tile, in the order in which the tile blends them."""

    starts: Int[np.ndarray, " tiles1"]
    """Where each tile's overlaps start; the last entry is their number."""
    gaussians: Int[np.ndarray, " m"]
    slots: Int[np.ndarray, " m"]
    """Where the backward pass writes what the overlap gives: those of a Gaussian lie together."""
    slot_starts: Int[np.ndarray, " n1"]


def sort_into_tiles(
    means: Float[np.ndarray, "n 2"],
    reaches: Float[np.ndarray, "n 2"],
    depths: Float[np.ndarray, " n"],
    width: int,
    height: int,
) -> Tiles:
    """Sort by tile, then by depth (in single precision, not negative), ties by index.

    An ellipse covers the pixel centres within its reach of its mean along x and y; one with a
    negative reach covers none.
    """
    n, columns, rows = len(means), math.ceil(width / TILE), math.ceil(height / TILE)
    boxes = np.empty((n, 4), np.int32)
    slot_starts = np.zeros(n + 1, np.int64)
    _find_boxes(means, reaches, columns, rows, boxes)
    order = np.empty(n, np.int32)
    drawn = _list_drawn(boxes, slot_starts, order)
    order = _sort(depths.astype(np.float32).view(np.uint32), order[:drawn])
    counts = np.zeros((numba.get_num_threads(), columns * rows), np.int64)
    _count(order, boxes, columns, counts)
    starts = np.zeros(columns * rows + 1, np.int64)
    _find_starts(counts, starts)
    gaussians, slots = np.empty((2, slot_starts[-1]), np.int32)
    _fill(order, boxes, slot_starts, columns, counts, gaussians, slots)
    return Tiles(starts, gaussians, slots, slot_starts)


@compiled(parallel=True)
def _find_boxes(means, reaches, columns, rows, boxes):
    """First and one past the last tile, along x and y."""
    for i in numba.prange(len(means)):
        for axis in range(2):
            most = (columns if axis == 0 else rows) * TILE - 1
            first = max(math.ceil(means[i, axis] - reaches[i, axis] - 0.5), 0)
            last = min(math.floor(means[i, axis] + reaches[i, axis] - 0.5), most)
            boxes[i, axis] = first // TILE
            boxes[i, axis + 2] = last // TILE + 1 if last >= first else first // TILE


@compiled()
def _list_drawn(boxes, slot_starts, order):
    """List those that touch a tile, and say how many; give each as many slots as tiles."""
    drawn = 0
    for i in range(len(boxes)):
        tiles = (boxes[i, 2] - boxes[i, 0]) * (boxes[i, 3] - boxes[i, 1])
        slot_starts[i + 1] = slot_starts[i] + tiles
        if tiles > 0:
            order[drawn] = i
            drawn += 1
    return drawn


@compiled()
def _sort(keys, order):
    """Stable radix sort of the indices in `order` by their keys."""
    target = np.empty_like(order)
    for digit in range(3):
        shift, mask = np.uint32(digit * _DIGIT_BITS), np.uint32(_DIGITS - 1)
        places = np.zeros(_DIGITS + 1, np.int64)
        for i in order:
            places[np.int64(keys[i] >> shift & mask) + 1] += 1
        for value in range(_DIGITS):
            places[value + 1] += places[value]
        for i in order:
            digit_of_i = np.int64(keys[i] >> shift & mask)
            target[places[digit_of_i]] = i
            places[digit_of_i] += 1
        order, target = target, order
    return order


@compiled(parallel=True)
def _count(order, boxes, columns, counts):
    """How many ellipses of each part of the order touch each tile."""
    parts = len(counts)
    for part in numba.prange(parts):
        for i in order[len(order) * part // parts : len(order) * (part + 1) // parts]:
            for row in range(boxes[i, 1], boxes[i, 3]):
                for column in range(boxes[i, 0], boxes[i, 2]):
                    counts[part, row * columns + column] += 1


@compiled()
def _find_starts(counts, starts):
    """Turn the counts into the place where each part starts to write in each tile."""
    total = 0
    for tile in range(counts.shape[1]):
        starts[tile] = total
        for part in range(len(counts)):
            counts[part, tile], total = total, total + counts[part, tile]
    starts[counts.shape[1]] = total


@compiled(parallel=True)
def _fill(order, boxes, slot_starts, columns, places, gaussians, slots):
    parts = len(places)
    for part in numba.prange(parts):
        for i in order[len(order) * part // parts : len(order) * (part + 1) // parts]:
            slot = slot_starts[i]
            for row in range(boxes[i, 1], boxes[i, 3]):
                for column in range(boxes[i, 0], boxes[i, 2]):
                    tile = row * columns + column
                    gaussians[places[part, tile]] = i
                    slots[places[part, tile]] = slot
                    places[part, tile] += 1
                    slot += 1
