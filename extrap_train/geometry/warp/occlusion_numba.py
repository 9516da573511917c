"""`occlusion` on the CPU: the same walls, one after the other, in compiled loops."""

import math

import numpy as np

from extrap_train.geometry.compiled import compiled
from extrap_train.geometry.warp import occlusion
from extrap_train.geometry.warp.query_projection import MIN_DEPTH_RATIO

_HALF, _ONE, _TWO = np.float32(0.5), np.float32(1), np.float32(2)
_MIN_RATIO = np.float32(MIN_DEPTH_RATIO)
_DEPTH_PER_WIDTH = np.float32(occlusion.DEPTH_PER_WIDTH)
_SPACING = np.float32(occlusion.SPACING)
_MAX_WALL_POINTS = np.float32(occlusion.MAX_WALL_POINTS)
_ACROSS = occlusion.ACROSS


@compiled()
def project(m, u, v, inverse):
    """`query_projection.project_pixels` of one pixel."""
    x = m[0, 0] * u + m[0, 1] * v + m[0, 2] + m[0, 3] * inverse
    y = m[1, 0] * u + m[1, 1] * v + m[1, 2] + m[1, 3] * inverse
    ratio = m[2, 0] * u + m[2, 1] * v + m[2, 2] + m[2, 3] * inverse
    safe = ratio if ratio > _MIN_RATIO else _ONE
    return x / safe, y / safe, ratio


@compiled()
def draw_occlusion(inverse, links, intrinsics, m, unseen):
    """Lower one reference's depth buffer `unseen` to the walls behind its occluding edges; links
    as in `surface_numba`."""
    height, width = inverse.shape
    for y in range(height):
        for x in range(width):
            if links[y, x] < 16:
                continue
            for side in range(4):
                if not links[y, x] >> (4 + side) & 1:
                    continue
                du, dv = (2 * side - 1, 0) if side < 2 else (0, 2 * side - 5)
                focal = intrinsics[side // 2, side // 2]
                run = np.float32(_run(links, y, x, -dv, -du, side ^ 1))
                start = inverse[y, x]
                deepest = start / (_ONE + _DEPTH_PER_WIDTH * run / focal)
                stop = max(deepest, inverse[y + dv, x + du])
                u = np.float32(x) + _HALF + np.float32(du) / _TWO
                v = np.float32(y) + _HALF + np.float32(dv) / _TWO
                _draw_wall(m, u, v, start, stop, side < 2, unseen)


@compiled()
def _run(links, y, x, dy, dx, side):
    """Pixels connected in a row from (y, x) towards `side`, itself included."""
    count = 1
    while links[y, x] >> side & 1:
        y, x, count = y + dy, x + dx, count + 1
    return count


@compiled()
def _draw_wall(m, u, v, start, stop, upright, unseen):
    height, width = unseen.shape
    x0, y0, _ = project(m, u, v, start)
    x1, y1, _ = project(m, u, v, stop)
    length = np.float32(math.sqrt((x1 - x0) * (x1 - x0) + (y1 - y0) * (y1 - y0)))
    count = math.ceil(min(max(length / _SPACING, _ONE), _MAX_WALL_POINTS))
    for i in range(count):
        along = (np.float32(i) + _HALF) / np.float32(count) - _HALF + _HALF
        inverse = start + (stop - start) * along
        for j in range(_ACROSS):
            aside = (np.float32(j) + _HALF) / np.float32(_ACROSS) - _HALF
            x, y, ratio = project(
                m, u if upright else u + aside, v + aside if upright else v, inverse
            )
            if ratio > _MIN_RATIO and 0 <= x < width and 0 <= y < height:
                row, column = int(y), int(x)
                unseen[row, column] = min(unseen[row, column], ratio / inverse)
