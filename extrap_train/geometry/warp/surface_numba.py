"""`surface.surface_from_depth` on the CPU: the same arithmetic, line by line, in compiled loops.

Links are bits: 0–3 say which neighbours (left, right, upper, lower) lie on the same surface, 4–7
on which sides a valid pixel's surface ends in front of another one.
"""

import numpy as np

from extrap_train.geometry.compiled import compiled
from extrap_train.geometry.warp import surface

_ZERO, _ONE = np.float32(0), np.float32(1)
_ALWAYS_SURFACE = np.float32(surface.ALWAYS_SURFACE)
_NEVER_SURFACE = np.float32(surface.NEVER_SURFACE)
_DEPTH_NOISE = np.float32(surface.DEPTH_NOISE)
_MAX_BEND = np.float32(surface.MAX_BEND)

_UNKNOWN, _LINKED, _RISES, _FALLS = 0, 1, 2, 3
"""What a step from one pixel to the next is; at a jump inverse depth rises or falls."""


@compiled()
def find_surface(depth, intrinsics, inverse_depth, side_slopes, side_links):
    """Fill in one reference's inverse depth (h w), slopes (4 h w) and links (h w); the pixels that
    lie on a surface (h w)."""
    height, width = depth.shape
    valid_pixels = np.empty((height, width), np.bool_)
    # Flat, so that rows and columns are the same to what follows: a start and a stride.
    inverse, valid = inverse_depth.reshape(-1), valid_pixels.reshape(-1)
    slopes, links = side_slopes.reshape((4, -1)), side_links.reshape(-1)
    for y in range(height):
        for x in range(width):
            known = depth[y, x] > 0 and depth[y, x] < np.inf
            inverse[y * width + x] = _ONE / depth[y, x] if known else _ZERO
            valid[y * width + x] = known
            links[y * width + x] = 0
    kinds = np.zeros(max(height, width) + 1, np.uint8)
    for axis in range(2):
        lines, length = (height, width) if axis == 0 else (width, height)
        to_line, to_pixel = (width, 1) if axis == 0 else (1, width)
        for i in range(lines):
            line = (i * to_line, to_pixel, length)
            _sort_steps(inverse, line, intrinsics[axis, axis], kinds)
            _connect(inverse, line, kinds, 2 * axis, slopes, links, valid)
    for pixel in range(height * width):
        if not (links[pixel] & 3 and links[pixel] & 12):
            valid[pixel] = False
        if not valid[pixel]:
            links[pixel] &= 15
    return valid_pixels


@compiled()
def _sort_steps(inverse, line, focal, kinds):
    """Kind of the step before each pixel of a line (its first pixel, stride, length); the ends of
    the line are unknown."""
    start, stride, length = line
    for i in range(1, length):
        here = inverse[start + i * stride]
        slope = here - inverse[start + (i - 1) * stride]
        farther = min(here, inverse[start + (i - 1) * stride])
        steep, limit = abs(slope), farther / focal
        if not farther > 0:
            kinds[i] = _UNKNOWN
        elif (
            steep < _ALWAYS_SURFACE * limit
            or steep < _DEPTH_NOISE * farther
            or (steep < _NEVER_SURFACE * limit and _is_straight(inverse, line, i))
        ):
            kinds[i] = _LINKED
        else:
            kinds[i] = _RISES if slope > 0 else _FALLS
    kinds[length] = _UNKNOWN


@compiled()
def _is_straight(inverse, line, i):
    """Whether the step before pixel `i` is one of three in a row with similar slopes."""
    run = 0
    for j in range(i - 2, i + 2):
        run = run + 1 if _bends_little(inverse, line, j) else 0
        if run == 2:
            return True
    return False


@compiled()
def _bends_little(inverse, line, i):
    start, stride, length = line
    if i < 1 or i >= length - 1:
        return False
    before, here, after = (
        inverse[start + (i - 1) * stride],
        inverse[start + i * stride],
        inverse[start + (i + 1) * stride],
    )
    first, second = here - before, after - here
    known = min(before, here, after) > 0
    return bool(known and abs(second - first) <= _MAX_BEND * max(abs(first), abs(second)))


@compiled()
def _connect(inverse, line, kinds, side, slopes, links, valid):
    """Slopes and links of a line's pixels to the previous one, on `side`, and the next, on the
    side after that."""
    start, stride, length = line
    for i in range(length):
        pixel = start + i * stride
        before, after = kinds[i], kinds[i + 1]
        to_before = to_after = _ZERO
        if before == _LINKED:
            to_before = inverse[pixel] - inverse[pixel - stride]
        if after == _LINKED:
            to_after = inverse[pixel + stride] - inverse[pixel]
        beyond_before, beyond_after = to_after, to_before
        if before != _LINKED and after == _LINKED and kinds[i + 2] == _LINKED:
            inner = inverse[pixel + 2 * stride] - inverse[pixel + stride]
            beyond_before = _extend_slope(to_after, inner)
        if after != _LINKED and before == _LINKED and kinds[i - 1] == _LINKED:
            inner = inverse[pixel - stride] - inverse[pixel - 2 * stride]
            beyond_after = _extend_slope(to_before, inner)
        slopes[side, pixel] = to_before if before == _LINKED else beyond_before
        slopes[side + 1, pixel] = to_after if after == _LINKED else beyond_after
        linked = (before == _LINKED) | (after == _LINKED) << 1
        ends = (before == _RISES) | (after == _FALLS) << 1
        links[pixel] |= (linked | ends << 4) << side
        if before == _FALLS or after == _RISES:
            valid[pixel] = False


@compiled()
def _extend_slope(slope, inner):
    """The slope beyond the end of a surface: changing on as it did just inside, at most
    twofold."""
    grown = slope - inner
    if not grown * slope > 0:
        return slope
    limited = min(abs(grown), abs(slope))
    return slope + (limited if grown > 0 else -limited)
