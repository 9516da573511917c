"""`visibility` on the CPU: ray after ray, each followed no further than its answer needs."""

import numba
import numpy as np

from extrap_train.geometry.compiled import compiled

_HALF, _ONE, _ZERO, _INFINITY = (np.float32(x) for x in (0.5, 1, 0, np.inf))
_TINY = np.float32(1e-20)


@compiled(parallel=True)
def trace_numba(depths, origin, steps, start, stop, stretch, limit, rules, entry, unobserved):
    """Fill `entry` and `unobserved`; `rules` are the number of samples, that of bisections, and the
    tolerance. The other arguments are those of `visibility._Rays`, in single precision."""
    images, height, width = limit.shape
    for task in numba.prange(images * height):
        image, row = task // height, task % height
        along = np.empty((depths.shape[1], 3), np.float32)
        v = np.float32(row) + _HALF
        for column in range(width):
            u = np.float32(column) + _HALF
            for k in range(len(along)):
                for i in range(3):
                    along[k, i] = (
                        steps[image, k, i, 0] * u
                        + steps[image, k, i, 1] * v
                        + steps[image, k, i, 2]
                    )
            first, length = _trace_ray(
                depths[image],
                origin[image],
                along,
                start[image, row, column],
                stop[image, row, column],
                limit[image, row, column],
                rules,
            )
            entry[image, row, column] = first
            unobserved[image, row, column] = length * stretch[image, row, column]


@compiled()
def _trace_ray(depths, origin, along, start, stop, limit, rules):
    """Where one ray first enters unobserved space, and over how much depth it stays there in front
    of `limit`."""
    samples, bisections, tolerance = rules
    margin = _ONE + np.float32(tolerance)
    step = (stop - start) / np.float32(samples)
    entry, length, last = _INFINITY, _ZERO, 0
    if not step > _ZERO:
        return entry, length
    for i in range(samples):
        depth = start + (np.float32(i) + _HALF) * step
        if (depth >= limit) & (entry < _INFINITY):
            break
        # The reference that saw the last point to be empty most often sees this one to be, too.
        if _is_empty(depths, origin, along, last, depth, margin):
            continue
        last = _find_empty(depths, origin, along, depth, margin)
        if last == len(depths):
            last = 0
            entry = min(entry, depth)
            length += step if depth < limit else _ZERO
    if entry < _INFINITY:
        before = max(entry - step, start)
        for _ in range(bisections):
            middle = (before + entry) * _HALF
            if _find_empty(depths, origin, along, middle, margin) < len(depths):
                before = middle
            else:
                entry = middle
        entry = (before + entry) * _HALF
    return entry, length


@compiled()
def _find_empty(depths, origin, along, depth, margin):
    """The first reference that has seen the ray's point to be empty; their number if none has."""
    for k in range(len(depths)):
        if _is_empty(depths, origin, along, k, depth, margin):
            return k
    return len(depths)


@compiled()
def _is_empty(depths, origin, along, k, depth, margin):
    """Whether reference `k` has seen the ray's point at a query depth to be empty."""
    height, width = np.float32(depths.shape[1]), np.float32(depths.shape[2])
    z = origin[k, 2] + depth * along[k, 2]
    over = _ONE / max(z, _TINY)
    x = (origin[k, 0] + depth * along[k, 0]) * over
    y = (origin[k, 1] + depth * along[k, 1]) * over
    if not ((z > _TINY) & (x >= _ZERO) & (y >= _ZERO) & (x < width) & (y < height)):
        return False
    return bool(depths[k, np.uint32(y), np.uint32(x)] > z * margin)
