"""`splat_samples` and `splat_unseen` on the CPU: the same arithmetic, pixel by pixel, in compiled
loops."""

import math

import numba
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.geometry import splat_pieces, splat_unseen
from extrap_train.geometry.compiled import compiled
from extrap_train.geometry.screen_points import OUTSIDE, ScreenPoints
from extrap_train.geometry.splat_pieces import Pieces, Samples
from extrap_train.geometry.splat_projection import LEAST_DEPTH_RATIO

# Single precision throughout, in the same order of operations as in torch: the same points come
# out.
_ONE, _HALF, _TWO, _ZERO = (np.float32(x) for x in (1, 0.5, 2, 0))
_LARGEST_SPACING = np.float32(splat_pieces.LARGEST_SPACING)
_REACH_MARGIN = np.float32(splat_pieces.REACH_MARGIN)
_MOST_POINTS = np.float32(splat_pieces.MOST_POINTS)
_LEAST_RATIO = np.float32(LEAST_DEPTH_RATIO)
_WALL_DEPTH = np.float32(splat_unseen.DEPTH_PER_WIDTH)
_WALL_SPACING = np.float32(splat_unseen.SPACING)
_WALL_MOST = np.float32(splat_unseen.MOST_POINTS)
_WALL_ACROSS = splat_unseen.ACROSS
_WALL_LIMIT = np.float32(1 + splat_unseen.TOLERANCE)
_NOWHERE = np.float32(OUTSIDE)


def sample_pieces_numba(pieces: Pieces, maps: Float[Tensor, "b k c h w"]) -> Samples:
    """The same points as torch makes; those that fall outside stay in, at a place outside the
    image."""
    surface, query = pieces.surface, pieces.query
    b, k, c, h, w = maps.shape
    inverse, drawn, valid = (
        x.reshape(b * k, h, w).numpy() for x in (surface.inverse_depth, pieces.drawn, surface.valid)
    )
    slopes, connected, ends = (
        x.reshape(b * k, 4, h, w).numpy() for x in (surface.slopes, surface.connected, surface.ends)
    )
    matrix = pieces.matrix.reshape(b * k, 3, 4).contiguous().numpy()
    focal = pieces.cameras.intrinsics.reshape(b * k, 3, 3).contiguous().numpy()
    unseen = np.full((b * k, query.height, query.width), np.float32(np.inf), np.float32)
    _draw_walls(inverse, valid, connected, ends, focal, matrix, unseen)
    stops = np.cumsum(_count(inverse, drawn, slopes, matrix))
    points = np.empty((5, stops[-1]), np.float32)
    values = np.empty((stops[-1], c), np.float32)
    planes = maps.reshape(b * k, c, h, w).contiguous().numpy()
    _fill(inverse, drawn, slopes, connected, matrix, planes, unseen, stops, points, values)
    per_image = torch.from_numpy(np.diff(stops[k * h - 1 :: k * h], prepend=0))
    image = torch.repeat_interleave(torch.arange(b), per_image)
    u, v, depth, reach_u, reach_v = torch.from_numpy(points)
    screen = ScreenPoints(u, v, depth, reach_u, reach_v, image)
    return Samples(screen, torch.from_numpy(values))


@compiled()
def _project(m: np.ndarray, u: float, v: float, inverse: float) -> tuple[float, float, float]:
    x = m[0, 0] * u + m[0, 1] * v + m[0, 2] + m[0, 3] * inverse
    y = m[1, 0] * u + m[1, 1] * v + m[1, 2] + m[1, 3] * inverse
    ratio = m[2, 0] * u + m[2, 1] * v + m[2, 2] + m[2, 3] * inverse
    safe = ratio if ratio > _LEAST_RATIO else _ONE
    return x / safe, y / safe, ratio


@compiled()
def _step(
    m: np.ndarray, u: float, v: float, ratio: float, axis: int, slope: float
) -> tuple[float, float, int]:
    """Movement in the query for one reference pixel along an axis, and how many points that
    takes."""
    z = m[2, axis] + slope * m[2, 3]
    across = (m[0, axis] + slope * m[0, 3] - u * z) / max(ratio, _LEAST_RATIO)
    down = (m[1, axis] + slope * m[1, 3] - v * z) / max(ratio, _LEAST_RATIO)
    count = min(
        np.float32(math.sqrt(across * across + down * down)) / _LARGEST_SPACING, _MOST_POINTS
    )
    return abs(across), abs(down), max(math.ceil(count), 1)


@compiled()
def _steps(
    m: np.ndarray, inverse: np.ndarray, slopes: np.ndarray, y: int, x: int
) -> tuple[tuple[float, float, int], tuple[float, float, int]]:
    u, v, ratio = _project(m, np.float32(x) + _HALF, np.float32(y) + _HALF, inverse[y, x])
    along_u = _step(m, u, v, ratio, 0, (slopes[0, y, x] + slopes[1, y, x]) / _TWO)
    along_v = _step(m, u, v, ratio, 1, (slopes[2, y, x] + slopes[3, y, x]) / _TWO)
    return along_u, along_v


@compiled(parallel=True)
def _count(
    inverse: np.ndarray, drawn: np.ndarray, slopes: np.ndarray, matrix: np.ndarray
) -> np.ndarray:
    """Points in each row of each reference."""
    references, height, _ = inverse.shape
    counts = np.zeros(references * height, np.int64)
    for task in numba.prange(references * height):
        r, y = task // height, task % height
        counts[task] = _count_row(inverse[r], drawn[r], slopes[r], matrix[r], y)
    return counts


@compiled()
def _count_row(
    inverse: np.ndarray, drawn: np.ndarray, slopes: np.ndarray, m: np.ndarray, y: int
) -> int:
    count = 0
    for x in range(inverse.shape[1]):
        if drawn[y, x]:
            along_u, along_v = _steps(m, inverse, slopes, y, x)
            count += along_u[2] * along_v[2]
    return count


@compiled(parallel=True)
def _fill(
    inverse: np.ndarray,
    drawn: np.ndarray,
    slopes: np.ndarray,
    connected: np.ndarray,
    matrix: np.ndarray,
    maps: np.ndarray,
    unseen: np.ndarray,
    stops: np.ndarray,
    points: np.ndarray,
    values: np.ndarray,
) -> None:
    references, height, _ = inverse.shape
    for task in numba.prange(references * height):
        r, y = task // height, task % height
        first = stops[task - 1] if task else 0
        surface = (inverse[r], drawn[r], slopes[r], connected[r])
        _fill_row(surface, matrix[r], maps[r], unseen[r], y, first, points, values)


@compiled()
def _fill_row(
    surface: tuple[np.ndarray, ...],
    m: np.ndarray,
    maps: np.ndarray,
    unseen: np.ndarray,
    y: int,
    n: int,
    points: np.ndarray,
    values: np.ndarray,
) -> None:
    inverse, drawn, slopes, connected = surface
    for x in range(inverse.shape[1]):
        if not drawn[y, x]:
            continue
        along_u, along_v = _steps(m, inverse, slopes, y, x)
        columns, rows = np.float32(along_u[2]), np.float32(along_v[2])
        reach_u = (along_u[0] / columns + along_v[0] / rows) / _TWO + _REACH_MARGIN
        reach_v = (along_u[1] / columns + along_v[1] / rows) / _TWO + _REACH_MARGIN
        for nth in range(along_u[2] * along_v[2]):
            du = (np.float32(nth % along_u[2]) + _HALF) / columns - _HALF
            dv = (np.float32(nth // along_u[2]) + _HALF) / rows - _HALF
            side_u, side_v = 1 if du > 0 else 0, 3 if dv > 0 else 2
            w = inverse[y, x] + (slopes[side_u, y, x] * du + slopes[side_v, y, x] * dv)
            u, v, ratio = _project(m, np.float32(x) + _HALF + du, np.float32(y) + _HALF + dv, w)
            if _seen(u, v, ratio, w, unseen):
                points[0, n], points[1, n], points[2, n] = u, v, ratio / w
            else:
                points[0, n], points[1, n], points[2, n] = _NOWHERE, _NOWHERE, _ONE
            points[3, n], points[4, n] = min(reach_u, _ONE), min(reach_v, _ONE)
            x2 = x + (2 * side_u - 1 if connected[side_u, y, x] else 0)
            y2 = y + (2 * side_v - 5 if connected[side_v, y, x] else 0)
            for c in range(maps.shape[0]):
                own = maps[c, y, x]
                blended = own + abs(du) * (maps[c, y, x2] - own)
                values[n, c] = blended + abs(dv) * (maps[c, y2, x] - own)
            n += 1


@compiled()
def _seen(u: float, v: float, ratio: float, inverse: float, unseen: np.ndarray) -> bool:
    height, width = unseen.shape
    inside = -_HALF < u < np.float32(width) + _HALF and -_HALF < v < np.float32(height) + _HALF
    if not (inside and inverse > _ZERO and ratio > _LEAST_RATIO):
        return False
    row, column = min(max(int(v), 0), height - 1), min(max(int(u), 0), width - 1)
    return not ratio / inverse > unseen[row, column] * _WALL_LIMIT


@compiled(parallel=True)
def _draw_walls(
    inverse: np.ndarray,
    valid: np.ndarray,
    connected: np.ndarray,
    ends: np.ndarray,
    intrinsics: np.ndarray,
    matrix: np.ndarray,
    unseen: np.ndarray,
) -> None:
    """Depth buffer of the walls behind occluding edges (`splat_unseen`)."""
    for r in numba.prange(len(inverse)):
        for side in range(4):
            surface = (inverse[r], valid[r], connected[r, side ^ 1], ends[r, side])
            focal = intrinsics[r, side // 2, side // 2]
            _draw_walls_of_side(surface, side, focal, matrix[r], unseen[r])


@compiled()
def _draw_walls_of_side(
    surface: tuple[np.ndarray, ...], side: int, focal: float, m: np.ndarray, unseen: np.ndarray
) -> None:
    inverse, valid, connected, ends = surface
    du = (2 * side - 1) if side < 2 else 0
    dv = (2 * side - 5) if side >= 2 else 0
    height, width = inverse.shape
    for y in range(height):
        for x in range(width):
            if not (ends[y, x] and valid[y, x]):
                continue
            run = np.float32(_run(connected, y, x, -dv, -du))
            start = inverse[y, x]
            stop = max(start / (_ONE + _WALL_DEPTH * run / focal), inverse[y + dv, x + du])
            u = np.float32(x) + _HALF + np.float32(du) / _TWO
            v = np.float32(y) + _HALF + np.float32(dv) / _TWO
            _draw_wall(m, u, v, start, stop, side < 2, unseen)


@compiled()
def _run(connected: np.ndarray, y: int, x: int, dy: int, dx: int) -> int:
    """Pixels connected in a row from (y, x) on, itself included."""
    count = 1
    while connected[y, x]:
        y, x, count = y + dy, x + dx, count + 1
    return count


@compiled()
def _draw_wall(
    m: np.ndarray, u: float, v: float, start: float, stop: float, upright: bool, unseen: np.ndarray
) -> None:
    height, width = unseen.shape
    x0, y0, _ = _project(m, u, v, start)
    x1, y1, _ = _project(m, u, v, stop)
    length = np.float32(math.sqrt((x1 - x0) * (x1 - x0) + (y1 - y0) * (y1 - y0)))
    count = math.ceil(min(max(length / _WALL_SPACING, _ONE), _WALL_MOST))
    for i in range(count):
        along = (np.float32(i) + _HALF) / np.float32(count) - _HALF + _HALF
        inverse = start + (stop - start) * along
        for j in range(_WALL_ACROSS):
            aside = (np.float32(j) + _HALF) / np.float32(_WALL_ACROSS) - _HALF
            x, y, ratio = _project(
                m, u if upright else u + aside, v + aside if upright else v, inverse
            )
            if ratio > _LEAST_RATIO and 0 <= x < width and 0 <= y < height:
                row, column = int(y), int(x)
                unseen[row, column] = min(unseen[row, column], ratio / inverse)
