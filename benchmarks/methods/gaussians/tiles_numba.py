"""Which Gaussians touch which tile of the image, nearest first."""

import math
from typing import NamedTuple

import numba
import numpy as np
from jaxtyping import Float, Int

from extrap_train.geometry.compiled import compiled

TILE = 16
"""Side of a tile in px."""


class Tiles(NamedTuple):
    """Every meeting of a Gaussian with a tile, in the order in which the tile blends them."""

    starts: Int[np.ndarray, " tiles1"]
    """Where each tile's meetings start; its last entry is their number."""
    gaussians: Int[np.ndarray, " m"]
    slots: Int[np.ndarray, " m"]
    """Where the backward pass writes what the meeting gives: those of a Gaussian lie together."""
    slot_starts: Int[np.ndarray, " n1"]


def sort_into_tiles(
    means: Float[np.ndarray, "n 2"],
    radii: Float[np.ndarray, "n 2"],
    depths: Float[np.ndarray, " n"],
    width: int,
    height: int,
) -> Tiles:
    """Sort by tile, then by depth, ties by index; Gaussians without a radius meet no tile."""
    boxes = np.empty((len(means), 4), np.int32)
    columns, rows = math.ceil(width / TILE), math.ceil(height / TILE)
    _find_boxes(means, radii, columns, rows, boxes)
    extents = (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])
    slot_starts = np.concatenate([[0], np.cumsum(extents, dtype=np.int64)])
    gaussians = np.empty(slot_starts[-1], np.int32)
    slots = np.empty(slot_starts[-1], np.int32)
    starts = np.zeros(columns * rows + 1, np.int64)
    order = np.argsort(depths, kind="stable")
    _fill(order, boxes, slot_starts, columns, starts, gaussians, slots)
    return Tiles(starts, gaussians, slots, slot_starts)


@compiled(parallel=True)
def _find_boxes(
    means: np.ndarray, radii: np.ndarray, columns: int, rows: int, boxes: np.ndarray
) -> None:
    """First and one past the last tile, along x and y."""
    for i in numba.prange(len(means)):
        boxes[i] = 0
        if radii[i, 0] > 0 and radii[i, 1] > 0:
            for axis in range(2):
                most = columns if axis == 0 else rows
                low = math.floor((means[i, axis] - radii[i, axis]) / TILE)
                high = math.ceil((means[i, axis] + radii[i, axis]) / TILE)
                boxes[i, axis] = min(max(low, 0), most)
                boxes[i, axis + 2] = min(max(high, 0), most)


@compiled()
def _fill(
    order: np.ndarray,
    boxes: np.ndarray,
    slot_starts: np.ndarray,
    columns: int,
    starts: np.ndarray,
    gaussians: np.ndarray,
    slots: np.ndarray,
) -> None:
    """Counting sort, stable, so that the order by depth survives within each tile."""
    for i in range(len(boxes)):
        for row in range(boxes[i, 1], boxes[i, 3]):
            for column in range(boxes[i, 0], boxes[i, 2]):
                starts[row * columns + column + 1] += 1
    for tile in range(len(starts) - 1):
        starts[tile + 1] += starts[tile]
    cursors = starts.copy()
    for i in order:
        slot = slot_starts[i]
        for row in range(boxes[i, 1], boxes[i, 3]):
            for column in range(boxes[i, 0], boxes[i, 2]):
                tile = row * columns + column
                gaussians[cursors[tile]] = i
                slots[cursors[tile]] = slot
                cursors[tile] += 1
                slot += 1
