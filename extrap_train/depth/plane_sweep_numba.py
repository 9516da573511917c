"""Expensive parts of a plane sweep, on the CPU: the matching cost and its semi-global sums."""

import numba
import numpy as np

from extrap_train.geometry.compiled import compiled

_HALF, _ONE, _ZERO, _INFINITY = (np.float32(x) for x in (0.5, 1, 0, np.inf))
_TINY = np.float32(1e-6)


@compiled(parallel=True, contract=True)
def correlation_cost_numba(
    inverse_depth, at_infinity, epipole, other, image, mean, variance, rules, cost
):
    """Fill `cost` (planes × height × width) with (1 − NCC) / 2 of a view's windows and those of one
    other view at the hypothetical depths; infinite where the other view does not see the point.

    `inverse_depth` is planes × height × width, per scene unit. `at_infinity` (height × width × 3)
    and `epipole` (3) are those of `photo_cost.Projection`. `image`, its windows' `mean` (both
    height × width × 3) and `other` are colours from 0 to 1; `variance` (height × width) is summed
    over the colours. `rules` are half the window's side in pixels and the noise.
    """
    half, noise = rules
    planes, height, width = inverse_depth.shape
    for plane in numba.prange(planes):
        # Three colours, the sum of their squares, and of their products with the view's own.
        maps = np.empty((5, height, width), np.float32)
        for row in range(height):
            _warp_row(
                inverse_depth[plane, row],
                at_infinity[row],
                epipole,
                other,
                image[row],
                maps[:, row],
                cost[plane, row],
            )
        sums = np.empty((5, width + 2 * half), np.float32)
        for row in range(height):
            first, last = max(row - half, 0), min(row + half, height - 1)
            for i in range(5):
                sums[i] = _ZERO
                for other_row in range(first, last + 1):
                    for column in range(width):
                        sums[i, half + column] += maps[i, other_row, column]
            _correlate_row(
                sums, last - first + 1, half, mean[row], variance[row], noise, cost[plane, row]
            )


@compiled(contract=True)
def _warp_row(inverse_depth, at_infinity, epipole, other, image, maps, cost):
    """Sample one row of the other view bilinearly; its cost is 0 where that sees the points."""
    height, width = other.shape[:2]
    for column in range(len(inverse_depth)):
        depth = inverse_depth[column]
        z = at_infinity[column, 2] + depth * epipole[2]
        over = _ONE / max(z, _TINY)
        u = (at_infinity[column, 0] + depth * epipole[0]) * over
        v = (at_infinity[column, 1] + depth * epipole[1]) * over
        inside = (u >= _ZERO) & (v >= _ZERO) & (u <= width) & (v <= height) & (z > _TINY)
        cost[column] = _ZERO if inside else _INFINITY
        x = min(max(u - _HALF, _ZERO), np.float32(width - 1))
        y = min(max(v - _HALF, _ZERO), np.float32(height - 1))
        left, top = np.int32(x), np.int32(y)
        right, bottom = min(left + 1, width - 1), min(top + 1, height - 1)
        x, y = x - np.float32(left), y - np.float32(top)
        squares, products = _ZERO, _ZERO
        for i in range(3):
            above = other[top, left, i] + x * (other[top, right, i] - other[top, left, i])
            below = other[bottom, left, i] + x * (other[bottom, right, i] - other[bottom, left, i])
            colour = above + y * (below - above)
            maps[i, column] = colour
            squares += colour * colour
            products += colour * image[column, i]
        maps[3, column] = squares
        maps[4, column] = products


@compiled(contract=True)
def _correlate_row(sums, rows, half, mean, variance, noise, cost):
    """The cost of one row from its columns' sums, which have `half` zeros on either side."""
    width = len(cost)
    for column in range(width):
        if cost[column] > _ZERO:
            continue
        columns = min(column + half, width - 1) - max(column - half, 0) + 1
        share = _ONE / np.float32(rows * columns)
        squares, covariance = _ZERO, _ZERO
        for offset in range(2 * half + 1):
            squares += sums[3, column + offset]
            covariance += sums[4, column + offset]
        squares, covariance = squares * share, covariance * share
        for i in range(3):
            total = _ZERO
            for offset in range(2 * half + 1):
                total += sums[i, column + offset]
            total *= share
            squares -= total * total
            covariance -= total * mean[column, i]
        other_variance = max(squares, _ZERO)
        correlation = covariance / np.sqrt((other_variance + noise) * (variance[column] + noise))
        cost[column] = (_ONE - min(max(correlation, -_ONE), _ONE)) * _HALF


@compiled(parallel=True)
def mean_of_better_numba(costs, out):
    """Mean over the better half of the neighbours (first axis); 0.5 where none sees the point."""
    neighbours, planes, height, width = costs.shape
    kept = (neighbours + 1) // 2
    for task in numba.prange(planes * height):
        plane, row = task // height, task % height
        best = np.empty(neighbours, np.float32)
        for column in range(width):
            for k in range(neighbours):
                cost, place = costs[k, plane, row, column], k
                while place > 0 and best[place - 1] > cost:
                    best[place] = best[place - 1]
                    place -= 1
                best[place] = cost
            total, seen = _ZERO, 0
            for k in range(kept):
                if best[k] < _INFINITY:
                    total += best[k]
                    seen += 1
            out[plane, row, column] = total / np.float32(seen) if seen > 0 else _HALF


@compiled(parallel=True)
def semi_global_numba(cost, penalties, steps, small_step, totals):
    """Add the least costs of the paths that come by each of `steps` (rows, columns); `totals` has
    several shares of the sum, each the size of `cost`, which are summed at the same time.

    `cost` is height × width × planes; a step's `penalty` is that of a jump into each pixel.
    """
    for share in numba.prange(len(totals)):
        for i in range(share, len(steps), len(totals)):
            _add_paths(cost, penalties[i], steps[i, 0], steps[i, 1], small_step, totals[share])


@compiled()
def _add_paths(cost, penalty, row_step, column_step, small_step, total):
    height, width, planes = cost.shape
    # The ends beyond the first and the last plane stay infinite.
    before, paths = np.full((2, width, planes + 2), _INFINITY, np.float32)
    start = np.full(planes + 2, _INFINITY, np.float32)
    start[1:-1] = _ZERO
    for i in range(height):
        row = i if row_step >= 0 else height - 1 - i
        for j in range(width):
            column = j if column_step >= 0 else width - 1 - j
            come_from = column - column_step
            path = start
            if 0 <= come_from < width and not (row_step != 0 and i == 0):
                path = before[come_from] if row_step != 0 else paths[come_from]
            _step(path, cost[row, column], penalty[row, column], small_step, paths[column])
            for plane in range(planes):
                total[row, column, plane] += paths[column, plane + 1]
        before, paths = paths, before


@compiled()
def _step(path, cost, penalty, small_step, out):
    """One pixel further: stay at a plane, change by one, or jump to any."""
    planes = len(cost)
    least = _INFINITY
    for plane in range(1, planes + 1):
        least = min(least, path[plane])
    for plane in range(planes):
        step = min(path[plane], path[plane + 2]) + small_step
        kept = min(min(path[plane + 1], step), least + penalty)
        out[plane + 1] = kept - least + cost[plane]
