"""Warp correction: where a pair's warp really belongs in its query view (paper III-A.1).

Wrong depths shift the warped image against the true one. A matcher finds where the warp's pixels
are in the truth, a smooth flow is fitted to the inliers, and the warp is drawn again with its
points moved by it. A correction must prove itself, and not only by what it was fitted to: any
two pictures come closer if one may be bent. Wrong depths move points along their epipolar lines
alone, so that matches that leave those lines are chance, and the warp stays as it is.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from extrap_train.depth import require_depth
from extrap_train.geometry.epipolar import steps_across
from extrap_train.geometry.spline_flow import fit_flow, flow_at, least_squares_flow
from extrap_train.geometry.warp import warp_references
from extrap_train.matching import Matcher
from extrap_train.views import Camera, View, Warp, stack_cameras

CORRECTION_VERSION = 3
"""Raised whenever the same frames give other corrections, so that old ones are made anew."""
MIN_MATCHES = 40
"""Fewer do not tell a smooth motion from chance."""
MAX_ACROSS = 0.006
"""Median distance of the matches from their points' epipolar lines, as a share of the picture's
longer side (0.75 px of 128). Correct depths give 0, real poses and matchers about half of this
limit, chance at least twice of it (docs/preparation.md)."""
MIN_INLIERS = 0.5
"""Share of the matches that a smooth motion must explain."""
MIN_STEP = 0.1
"""Pixels that the matches must move by, in the median: a matcher knows no less, and exact depths
are not to be moved."""
MIN_GAIN = 0.01
"""Share of the photometric error that a correction must take away: less is within what resampling
does to a warp. Says nothing of chance, which takes away as much."""
STIFFER = (1e-4, 1e-3)
"""Also tried instead of `spline_flow.STIFFNESS`: noise in the depths shakes a field that bends
easily."""
MAX_MATCHES = 2000
"""A smooth field needs no more."""


@dataclass(frozen=True)
class Correction:
    """What came of one pair."""

    flow: Float[Tensor, "2 g g"] | None
    """Control vectors (`geometry.spline_flow`); None where the warp stays as it is."""
    error_before: float
    """Photometric error of the warp against the truth; NaN of none. Over what the warp shows; for
    an accepted correction, over what both warps show.
    """
    error_after: float
    """The same with the correction; `error_before` where there is none."""
    reason: str = ""
    """Why the warp stays as it is."""


def correct_pair(reference: View, query: View, matcher: Matcher, grid: int) -> Correction:
    """The flow that brings a reference's warp to where the true query image shows the same.

    `grid` is the number of control points along each side of the flow.
    """
    camera, before = query.camera, draw(reference, query.camera)
    as_it_is = photometric_error(before, query.image)

    def leave(reason: str) -> Correction:
        return Correction(None, as_it_is, as_it_is, reason)

    matches = matcher.match(before.image[0], query.image, before.mask[0] > 0)
    if len(matches) < MIN_MATCHES:
        return leave(f"only {len(matches)} matches")
    chosen = torch.linspace(0, len(matches) - 1, min(len(matches), MAX_MATCHES)).long()
    matches = matches[chosen]
    steps = matches.first_to_second
    across = float(steps_across(matches.first, steps, reference.camera, camera).median())
    if across > MAX_ACROSS * max(camera.width, camera.height):
        return leave(f"the matches lie {across:.1f} px off their epipolar lines")
    size = torch.tensor([camera.width, camera.height])
    positions, steps = matches.first / size * 2 - 1, steps / size * 2
    flow, inliers = fit_flow(positions, steps, matches.confidence, grid)
    share = float(inliers.float().mean())
    if share < MIN_INLIERS:
        return leave(f"{share:.0%} of the matches move together")
    positions, steps, weights = positions[inliers], steps[inliers], matches.confidence[inliers]
    left = (steps - flow_at(flow, positions)).norm(dim=1).median()
    if not left < steps.norm(dim=1).median():  # no nearer to where they belong than before
        return leave("the matches have no motion in common")
    if float((steps * size / 2).norm(dim=1).median()) < MIN_STEP:
        return leave("the matches hardly move")
    flows = [flow, *(least_squares_flow(positions, steps, weights, grid, s) for s in STIFFER)]
    best = max((_try_flow(before, reference, query, flow) for flow in flows), key=_gain)
    return best if _gain(best) >= MIN_GAIN else leave("the picture comes no closer")


def _try_flow(
    before: Warp, reference: View, query: View, flow: Float[Tensor, "2 g g"]
) -> Correction:
    # As it is stored, so that what is judged is what training draws.
    flow = flow.half().float()
    after = draw(reference, query.camera, flow)
    return Correction(flow, *errors_in_common(before, after, query.image))


def _gain(correction: Correction) -> float:
    """Share of the error that a correction takes away; −1 where nothing can be compared."""
    gain = 1 - correction.error_after / max(correction.error_before, 1e-12)
    return gain if math.isfinite(gain) else -1.0


def draw(reference: View, query: Camera, flow: Float[Tensor, "2 g g"] | None = None) -> Warp:
    """The warp of one reference, its points moved by `flow`."""
    return warp_references(
        reference.image[None, None],
        require_depth(reference)[None, None],
        stack_cameras([stack_cameras([reference.camera])]),
        torch.ones(1, 1, dtype=torch.bool),
        stack_cameras([query]),
        None if flow is None else flow[None, None],
    )


def photometric_error(
    warp: Warp, truth: Float[Tensor, "3 h w"], where: Bool[Tensor, "h w"] | None = None
) -> float:
    """Mean absolute difference in colour over what the warp shows; NaN where it shows nothing.

    Both pictures are smoothed a little first: single pixels are a matter of sampling.
    """
    seen = warp.mask[0] > 0 if where is None else where
    if not seen.any():
        return float("nan")
    weight = seen.float()[None, None]
    difference = (_smooth((warp.image - truth) * weight) / _smooth(weight).clamp_min(1e-6))[0]
    return float(difference.abs().mean(0)[seen].mean())


def _smooth(image: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
    return functional.avg_pool2d(image, 3, 1, 1, count_include_pad=False)


def errors_in_common(
    before: Warp, after: Warp, truth: Float[Tensor, "3 h w"]
) -> tuple[float, float]:
    """Both errors over the pixels that both warps show, so that neither wins by showing less."""
    both = (before.mask[0] > 0) & (after.mask[0] > 0)
    return photometric_error(before, truth, both), photometric_error(after, truth, both)
