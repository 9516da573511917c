"""`sample` on the CPU: the same points, in compiled loops parallel over references and rows.

Single precision throughout, in the same order of operations as in torch: no decision comes out
otherwise.
"""

import math

import numba
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from extrap_train.geometry.cameras import coordinate_grid
from extrap_train.geometry.compiled import compiled
from extrap_train.geometry.spline_flow import flow_at_pixels
from extrap_train.geometry.warp import occlusion, sample
from extrap_train.geometry.warp.occlusion_numba import draw_occlusion, project
from extrap_train.geometry.warp.query_projection import MIN_DEPTH_RATIO, reference_to_query_pixels
from extrap_train.geometry.warp.sample import query_centers
from extrap_train.geometry.warp.surface_numba import find_surface
from extrap_train.views import Camera

_ZERO, _HALF, _ONE, _TWO = (np.float32(x) for x in (0, 0.5, 1, 2))
_MAX_SPACING = np.float32(sample.MAX_SPACING)
_REACH_MARGIN = np.float32(sample.REACH_MARGIN)
_MAX_POINTS = sample.MAX_POINTS_PER_AXIS
_MIN_RATIO = np.float32(MIN_DEPTH_RATIO)
_WALL_LIMIT = np.float32(1 + occlusion.TOLERANCE)
_RIM = np.float32(1.5)
"""Query pixels around the image: the splat draws what lies half a pixel outside; the rest is for
rounding."""
_ROWS = 16
"""Rows of a reference that are filled in one go."""
_OFFSETS = np.zeros((_MAX_POINTS + 1, _MAX_POINTS), np.float32)
"""Where in a pixel, counted from its centre, the points lie, by the number that it is cut into."""
for _n in range(1, _MAX_POINTS + 1):
    _OFFSETS[_n] = (np.arange(_MAX_POINTS, dtype=np.float32) + _HALF) / np.float32(_n) - _HALF


def sample_surfaces_numba(
    images: Float[Tensor, "b k 3 h w"],
    depths: Float[Tensor, "b k h w"],
    cameras: Camera,
    query: Camera,
) -> tuple[
    Float[np.ndarray, "3 n"],
    Float[np.ndarray, "2 n"],
    Float[np.ndarray, "n 7"],
    Int[np.ndarray, "b m 2"],
]:
    """The same points as torch makes, their reach, their values, and the spans of each query's, as
    `splat_numba` wants them."""
    b, k, h, w = depths.shape
    n = b * k
    intrinsics, centers, matrix = (
        x.reshape(n, *x.shape[2:]).contiguous().numpy()
        for x in (
            cameras.intrinsics,
            query_centers(cameras, query),
            reference_to_query_pixels(cameras, query),
        )
    )
    inverse, reaches = np.empty((n, h, w), np.float32), np.empty((2, n, h, w), np.float32)
    slopes = np.empty((n, 4, h, w), np.float32)
    links, counts = np.empty((n, h, w), np.uint8), np.empty((2, n, h, w), np.uint8)
    unseen = np.full((n, query.height, query.width), np.float32(np.inf), np.float32)
    sizes = np.empty((n, -(-h // _ROWS)), np.int64)
    cut = (inverse, slopes, links, counts, reaches)
    depth = depths.reshape(n, h, w).contiguous().numpy()
    _cut(depth, intrinsics, centers, matrix, *cut, unseen, sizes)
    total = int(sizes.sum())
    points, reach = np.empty((3, total), np.float32), np.empty((2, total), np.float32)
    values = np.empty((total, 7), np.float32)
    spans = (np.cumsum(sizes) - sizes.ravel())[:, None].repeat(2, 1)
    colours = images.reshape(n, 3, h, w).contiguous().numpy()
    grid = coordinate_grid(h, w).contiguous().numpy()
    _fill(*cut, matrix, colours, grid, k, unseen, spans, points, reach, values)
    return points, reach, values, spans.reshape(b, -1, 2)


def move_points_numba(
    points: Float[np.ndarray, "3 n"],
    spans: Int[np.ndarray, "b m 2"],
    flows: Float[Tensor, "b k 2 g g"],
    query: Camera,
) -> None:
    """Move the points in place to where their reference's flow takes them."""
    references = flows.flatten(0, 1)
    own_spans = spans.reshape(len(references), -1, 2)
    for flow, own in zip(references, own_spans, strict=True):
        if not flow.any():
            continue
        for first, last in own:
            pixels = points[:2, first:last]
            step = flow_at_pixels(flow, torch.from_numpy(pixels), query.height, query.width)
            pixels += step.numpy()


@compiled(parallel=True)
def _cut(
    depth, intrinsics, centers, matrix, inverse, slopes, links, counts, reaches, unseen, sizes
):
    """Every reference's surface, its walls, and into how many points each pixel and each block of
    rows is cut."""
    for r in numba.prange(len(depth)):
        valid = find_surface(depth[r], intrinsics[r], inverse[r], slopes[r], links[r])
        draw_occlusion(inverse[r], links[r], intrinsics[r], matrix[r], unseen[r])
        surface = (inverse[r], slopes[r], valid)
        camera = (intrinsics[r], centers[r], matrix[r])
        _cut_pixels(surface, camera, unseen[r].shape, counts[:, r], reaches[:, r], sizes[r])


@compiled()
def _cut_pixels(surface, camera, query_size, counts, reaches, sizes):
    """Points and reach of each pixel; none where the query sees its back, or not even its rim."""
    inverse, slopes, valid = surface
    intrinsics, center, m = camera
    sizes[:] = 0
    for y in range(inverse.shape[0]):
        for x in range(inverse.shape[1]):
            across = down = 0
            facing = valid[y, x] and _faces(inverse, slopes, intrinsics, center, y, x)
            if facing and _may_be_seen(m, inverse, slopes, y, x, query_size):
                across, down, reaches[0, y, x], reaches[1, y, x] = _divide(m, inverse, slopes, y, x)
            counts[0, y, x], counts[1, y, x] = across, down
            sizes[y // _ROWS] += across * down


@compiled()
def _may_be_seen(m, inverse, slopes, y, x, size):
    """Whether any of a pixel's surface may lie in the query's image, or within `_RIM` of it.

    Close to the query a pixel is cut into many points, most of which lie outside the image: this
    test keeps them from being made.
    Never wrongly no; wrongly yes at most near the image's corners. In homogeneous coordinates each
    side of the image is a linear function of the place in each quarter of the pixel, so its
    greatest value lies at a corner.
    """
    height, width = np.float32(size[0]), np.float32(size[1])
    return bool(
        _greatest(m, inverse, slopes, y, x, _ZERO, _ZERO, _ONE) > _ZERO
        and _greatest(m, inverse, slopes, y, x, _ONE, _ZERO, _RIM) > _ZERO
        and _greatest(m, inverse, slopes, y, x, -_ONE, _ZERO, width + _RIM) > _ZERO
        and _greatest(m, inverse, slopes, y, x, _ZERO, _ONE, _RIM) > _ZERO
        and _greatest(m, inverse, slopes, y, x, _ZERO, -_ONE, height + _RIM) > _ZERO
    )


@compiled()
def _greatest(m, inverse, slopes, y, x, a, b, c):
    """Maximum of `a·X + b·Y + c·ratio` over a pixel; (X, Y) / ratio is its place in the query."""
    along_u = a * m[0, 0] + b * m[1, 0] + c * m[2, 0]
    along_v = a * m[0, 1] + b * m[1, 1] + c * m[2, 1]
    constant = a * m[0, 2] + b * m[1, 2] + c * m[2, 2]
    along_w = a * m[0, 3] + b * m[1, 3] + c * m[2, 3]
    middle = along_u * (np.float32(x) + _HALF) + along_v * (np.float32(y) + _HALF) + constant
    middle += along_w * inverse[y, x]
    left = -(along_u + along_w * slopes[0, y, x])
    right = along_u + along_w * slopes[1, y, x]
    up = -(along_v + along_w * slopes[2, y, x])
    down = along_v + along_w * slopes[3, y, x]
    return middle + _HALF * (max(left, right, _ZERO) + max(up, down, _ZERO))


@compiled()
def _faces(inverse, slopes, k, center, y, x):
    """Whether the query's centre lies on the reference's side of the tangent plane
    (`surface.plane_vectors`)."""
    away_x = (slopes[0, y, x] + slopes[1, y, x]) / _TWO * k[0, 0]
    away_y = (slopes[2, y, x] + slopes[3, y, x]) / _TWO * k[1, 1]
    ray_x = (np.float32(x) + _HALF - k[0, 2]) / k[0, 0]
    ray_y = (np.float32(y) + _HALF - k[1, 2]) / k[1, 1]
    away_z = inverse[y, x] - away_x * ray_x - away_y * ray_y
    return bool(away_x * center[0] + away_y * center[1] + away_z * center[2] < _ONE)


@compiled()
def _divide(m, inverse, slopes, y, x):
    """Points of a pixel along u and v, and the reach in the query of each."""
    u, v, ratio = project(m, np.float32(x) + _HALF, np.float32(y) + _HALF, inverse[y, x])
    u_u, u_v = _step(m, u, v, ratio, 0, (slopes[0, y, x] + slopes[1, y, x]) / _TWO)
    v_u, v_v = _step(m, u, v, ratio, 1, (slopes[2, y, x] + slopes[3, y, x]) / _TWO)
    across, down = _points_along(u_u, u_v), _points_along(v_u, v_v)
    columns, rows = np.float32(across), np.float32(down)
    reach_u = (u_u / columns + v_u / rows) / _TWO + _REACH_MARGIN
    reach_v = (u_v / columns + v_v / rows) / _TWO + _REACH_MARGIN
    return across, down, min(reach_u, _ONE), min(reach_v, _ONE)


@compiled()
def _step(m, u, v, ratio, axis, slope):
    """Movement in the query, along its u and v, for one reference pixel along an axis."""
    z = m[2, axis] + slope * m[2, 3]
    across = (m[0, axis] + slope * m[0, 3] - u * z) / max(ratio, _MIN_RATIO)
    down = (m[1, axis] + slope * m[1, 3] - v * z) / max(ratio, _MIN_RATIO)
    return abs(across), abs(down)


@compiled()
def _points_along(across, down):
    length = np.float32(math.sqrt(across * across + down * down)) / _MAX_SPACING
    return max(math.ceil(min(length, np.float32(_MAX_POINTS))), 1)


@compiled(parallel=True)
def _fill(
    inverse,
    slopes,
    links,
    counts,
    reaches,
    matrix,
    colours,
    grid,
    k,
    unseen,
    spans,
    points,
    reach,
    values,
):
    """Points, their reach and values, and where the span of each block ends: at most where the
    next begins."""
    height, blocks = inverse.shape[1], len(spans) // len(inverse)
    for task in numba.prange(len(spans)):
        r, block = task // blocks, task % blocks
        surface = (inverse[r], slopes[r], links[r], counts[:, r], reaches[:, r])
        maps = (colours[r], grid, np.float32(r % k == 0))
        n = spans[task, 0]
        for y in range(block * _ROWS, min((block + 1) * _ROWS, height)):
            n = _fill_row(surface, matrix[r], maps, unseen[r], y, n, points, reach, values)
        spans[task, 1] = n


@compiled()
def _fill_row(surface, m, maps, unseen, y, n, points, reach, values):
    """Write the row's points that the query sees from place `n` on, and say where they end."""
    inverse, slopes, links, counts, reaches = surface
    for x in range(inverse.shape[1]):
        columns, rows = counts[0, y, x], counts[1, y, x]
        for row in range(rows):
            dv = _OFFSETS[rows, row]
            side_v = 3 if dv > 0 else 2
            along_v = slopes[side_v, y, x] * dv
            for column in range(columns):
                du = _OFFSETS[columns, column]
                side_u = 1 if du > 0 else 0
                w = inverse[y, x] + (slopes[side_u, y, x] * du + along_v)
                u, v, ratio = project(m, np.float32(x) + _HALF + du, np.float32(y) + _HALF + dv, w)
                if not _is_seen(u, v, ratio, w, unseen):
                    continue
                points[0, n], points[1, n], points[2, n] = u, v, ratio / w
                reach[0, n], reach[1, n] = reaches[0, y, x], reaches[1, y, x]
                x2 = x + (2 * side_u - 1 if links[y, x] >> side_u & 1 else 0)
                y2 = y + (2 * side_v - 5 if links[y, x] >> side_v & 1 else 0)
                _blend(maps, (y, x, y2, x2), abs(du), abs(dv), values[n])
                values[n, 6] = points[2, n]
                n += 1
    return n


@compiled()
def _blend(maps, pixels, share_u, share_v, values):
    """Colour and coordinates between a pixel (y, x) and its neighbours (y, x2) and (y2, x)."""
    colours, grid, nearest = maps
    y, x, y2, x2 = pixels
    for c in range(3):
        own = colours[c, y, x]
        towards_u = share_u * (colours[c, y, x2] - own)
        values[c] = own + towards_u + share_v * (colours[c, y2, x] - own)
    values[3] = (grid[0, y, x] + share_u * (grid[0, y, x2] - grid[0, y, x])) * nearest
    values[4] = (grid[1, y, x] + share_v * (grid[1, y2, x] - grid[1, y, x])) * nearest
    values[5] = nearest


@compiled()
def _is_seen(u, v, ratio, inverse, unseen):
    """Whether a point lies in the image, before the query, and not behind what the reference
    never saw."""
    height, width = unseen.shape
    inside = -_HALF < u < np.float32(width) + _HALF and -_HALF < v < np.float32(height) + _HALF
    if not (inside and inverse > _ZERO and ratio > _MIN_RATIO):
        return False
    row, column = min(max(int(v), 0), height - 1), min(max(int(u), 0), width - 1)
    return not ratio / inverse > unseen[row, column] * _WALL_LIMIT
