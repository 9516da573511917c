"""The unknown scale of depth maps by the photographs: at the right one, depth takes every pixel to
where other views show the same. What is left is how far the depths of two views differ.
"""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.depth.neighbours import (
    WIDEST_RAD,
    convergence_point,
    inverse_depth_range,
    neighbours_of,
)
from extrap_train.depth.photo_cost import PhotoCost
from extrap_train.geometry.cameras import project, unproject_to_world
from extrap_train.geometry.resample import sample_surfaces
from extrap_train.views import View

NEIGHBOURS = 4
MAX_VIEWS = 12
"""That one common scale is found from, spread over all."""
SEARCHES = ((128, 0.03, 0), (256, 0.006, 6), (256, 0.0012, 6))
"""Longer side in pixels, step between the logarithms of scales, and steps to either side of the
scale that the search before has found; the first search is over all possible scales."""
COMPARED = 4096
"""About so many pixels of a view are compared with other views."""
TELLING = 1.5
"""A scale that is wrong by this factor must fit worse, ..."""
MIN_RISE = 0.02
"""... by so much of the cost, 0 to 1, or the views do not tell the scale."""


def solve_scales(views: Sequence[View], *, per_view: bool) -> list[float | None]:
    """The factor of each view's depth at which its pixels look most like other views.

    One for all views, or one `per_view`. None where the photographs do not tell it. The cost is
    that of plane-sweep stereo, the mean over the pixels of known depth.
    """
    groups = [[i] for i in range(len(views))] if per_view else [[*range(len(views))]]
    helpers = neighbours_of(views, NEIGHBOURS, WIDEST_RAD)
    scales: list[float | None] = [None] * len(views)
    for group in groups:
        able = [i for i in group if helpers[i]]
        some = able[:: math.ceil(len(able) / MAX_VIEWS)] if able else []
        found = _solve_group(views, some, helpers)
        for i in group:
            scales[i] = found
    return scales


def _solve_group(
    views: Sequence[View], group: Sequence[int], helpers: Sequence[Sequence[int]]
) -> float | None:
    bounds = _log_bounds(views, group, helpers)
    if bounds is None:
        return None
    low, high = bounds
    found = 0.0
    for size, step, reach in SEARCHES:
        if reach:
            low, high = found - reach * step, found + reach * step
        candidates = torch.linspace(low, high, math.ceil((high - low) / step) + 1)
        costs = _costs(views, group, helpers, candidates, size)
        found = float(candidates[int(costs.argmin())])
    apart = torch.tensor([found - math.log(TELLING), found, found + math.log(TELLING)])
    below, right, above = _costs(views, group, helpers, apart, SEARCHES[0][0]).tolist()
    return math.exp(found) if min(below, above) > right + MIN_RISE else None


def _costs(
    views: Sequence[View],
    group: Sequence[int],
    helpers: Sequence[Sequence[int]],
    log_scales: Float[Tensor, " s"],
    size: int,
) -> Float[Tensor, " s"]:
    """Mean cost, 0 to 1, of the pixels with depth in a group of views, at each scale."""
    total, count = torch.zeros(len(log_scales)), 0
    for i in group:
        view, *others = (_shrink(views[j], size) for j in (i, *helpers[i]))
        assert view.depth is not None
        known = view.depth > 0
        inverse = torch.where(known, 1 / view.depth, 0)
        scales = log_scales.exp().to(inverse)
        cost = PhotoCost(view, others)(inverse / scales[:, None, None])
        total += cost[:, known].sum(1).cpu()
        count += int(known.sum())
    return total / max(count, 1)


def _shrink(view: View, size: int) -> View:
    factor = min(1, size / max(view.camera.height, view.camera.width))
    return view.resized(*(max(1, round(factor * s)) for s in view.image.shape[1:]))


def _log_bounds(
    views: Sequence[View], group: Sequence[int], helpers: Sequence[Sequence[int]]
) -> tuple[float, float] | None:
    """Logarithms of the scales between which the views can see anything in common."""
    center = convergence_point([view.camera for view in views]) if len(views) > 1 else None
    low, high = math.inf, -math.inf
    for i in group:
        depth = views[i].depth
        assert depth is not None
        if depth.any():
            others = [views[j].camera for j in helpers[i]]
            least, greatest = inverse_depth_range(views[i].camera, others, center)
            typical = float(depth[depth > 0].median())
            low = min(low, -math.log(greatest * typical))
            high = max(high, -math.log(least * typical))
    return (low, high) if low < high else None


def differences(views: Sequence[View]) -> list[float | None]:
    """Median relative difference of each view's depth from that of other views.

    A pixel counts by the neighbour that agrees best, for it may be hidden from the others. None for
    a view of which no neighbour sees anything.
    """
    helpers = neighbours_of(views, NEIGHBOURS, WIDEST_RAD)
    return [
        _difference(view, [views[j] for j in others])
        for view, others in zip(views, helpers, strict=True)
    ]


def _difference(view: View, others: Sequence[View]) -> float | None:
    assert view.depth is not None
    points = unproject_to_world(view.depth, view.camera)[view.depth > 0]
    points = points[:: max(1, len(points) // COMPARED)]
    best = torch.full_like(points[:, 0], torch.inf)
    for other in others:
        assert other.depth is not None
        pixels, depth = project(points, other.camera)
        size = pixels.new_tensor([other.camera.width, other.camera.height])
        inside = ((pixels >= 0) & (pixels < size)).all(-1) & (depth > 0)
        seen = sample_surfaces(other.depth[None], torch.where(inside[:, None], pixels, 0))[0]
        error = (depth / seen - 1).abs()
        best = torch.where(inside & (seen > 0), best.minimum(error), best)
    compared = best[best.isfinite()]
    return float(compared.median()) if len(compared) else None
