"""Depth of single pictures, set right by what matches in other views say at a few points."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.config import MonocularConfig
from extrap_train.depth import DepthMap, PointMaps, point_maps_of
from extrap_train.depth.neighbours import WIDEST_RAD, neighbours_of
from extrap_train.errors import InputError
from extrap_train.geometry.epipolar import triangulate
from extrap_train.geometry.resample import sample_pixels
from extrap_train.matching import Matcher
from extrap_train.views import View, combine

LOG = logging.getLogger(__name__)
MIN_PARALLAX_RAD = 0.02
"""About 1°: below it a match says little of depth."""
MAX_ERROR = 0.003
"""From the epipolar line, as a share of the picture's longer side; at least a pixel."""
MIN_POINTS = 20
EXPLAINED = 0.05
"""Relative error of depth up to which a triangulated point agrees."""
FARTHEST = 3.0
"""Multiple of the farthest known point beyond which the line says nothing of depth."""


@dataclass(frozen=True)
class _Points:
    """Pixels of a view with their depth, and how far to trust it."""

    pixels: Float[Tensor, "n 2"]
    depth: Float[Tensor, " n"]
    weights: Float[Tensor, " n"]


class NotAligned(InputError):
    """Why one view's depth has neither scale nor shift."""


@runtime_checkable
class InverseDepthNetwork(Protocol):
    """What a single picture says."""

    @property
    def image_size(self) -> int:
        """Side, in pixels, of what the network sees."""
        ...

    def inverse_depth(self, image: Float[Tensor, "3 h w"]) -> Float[Tensor, "h w"]:
        """Greater is nearer, up to scale and shift."""
        ...


@dataclass(frozen=True)
class MonocularDepth:
    """1/z = scale · network + shift, both from triangulated matches at the known poses.

    Confidence is the share of those matches whose depth the result explains within 5 %: one number
    a view, 0 where the line leaves depth without meaning.
    """

    config: MonocularConfig
    network: InverseDepthNetwork = field(repr=False, compare=False)
    matcher: Matcher

    @property
    def image_size(self) -> int:
        """Longer side that depth is estimated at, in pixels."""
        return self.network.image_size

    def point_maps(self, first: View, second: View) -> PointMaps:
        """Both views' points in the first camera's frame.

        InputError if the two have too few matches.
        """
        one, two = self.depth_map(first, [second]), self.depth_map(second, [first])
        return point_maps_of(first, one, second, two)

    def depth_map(self, view: View, neighbours: Sequence[View]) -> DepthMap:
        """One view's depth; the neighbours give it scale and shift.

        InputError if too few points of it are found in them, or these contradict the network.
        """
        helpers = self._neighbours([view, *neighbours])[0]
        return self._align(view, [neighbours[i - 1] for i in helpers])

    def depth_maps(self, views: Sequence[View]) -> list[DepthMap]:
        """The depth of every view; 0, unknown, where `depth_map` would raise, and a warning why."""
        return [
            self._align_or_unknown(view, [views[j] for j in helpers])
            for view, helpers in zip(views, self._neighbours(views), strict=True)
        ]

    def _align_or_unknown(self, view: View, helpers: Sequence[View]) -> DepthMap:
        try:
            return self._align(view, helpers)
        except NotAligned as reason:
            LOG.warning("no depth: %s", reason)
            return DepthMap(*torch.zeros_like(view.image[:2]))

    def _neighbours(self, views: Sequence[View]) -> list[list[int]]:
        return neighbours_of(views, self.config.neighbours, WIDEST_RAD)

    def _align(self, view: View, helpers: Sequence[View]) -> DepthMap:
        """NotAligned where too few points are found, or they are not nearer where it says so."""
        name = view.name or "a view"
        parts = [self._points(view, helper) for helper in helpers]
        count = sum(len(part.depth) for part in parts)
        if count < MIN_POINTS:
            raise NotAligned(
                f"{name}: {count} of its points are found in other views, fewer than the "
                f"{MIN_POINTS} that its scale and shift need; add photographs "
                "or choose another depth.matcher"
            )
        points = combine(parts, torch.cat)
        predicted = self.network.inverse_depth(view.image)
        at_points = sample_pixels(predicted[None], points.pixels)[0]
        line = robust_line(at_points, 1 / points.depth, points.weights)
        if line is None:
            raise NotAligned(
                f"{name}: the network says the same of all {count} points that are found in other "
                "views; the network is unfit for this picture: try depth=stereo"
            )
        if line.slope <= 0:
            raise NotAligned(
                f"{name}: the network and the {count} points that are found in other views "
                "contradict each other: what it takes for nearer is farther; matches or poses are "
                "wrong, or the network is unfit: try another depth.matcher or depth=stereo"
            )
        explained = (line(at_points) * points.depth - 1).abs() <= EXPLAINED
        if not explained.any():
            raise NotAligned(
                f"{name}: the network's depth agrees with none of the {count} points that are "
                "found in other views; try another depth.matcher or depth=stereo"
            )
        inverse = line(predicted)
        # Not of all points: a single wrong match may lie anywhere.
        near_enough = inverse > 1 / (FARTHEST * points.depth[explained].max())
        confidence = explained.float().mean() * near_enough
        return DepthMap(torch.where(near_enough, 1 / inverse, 0), confidence)

    def _points(self, view: View, helper: View) -> _Points:
        matches = self.matcher.match(view.image, helper.image)
        found = triangulate(matches.first, matches.second, view.camera, helper.camera)
        largest = max(1.0, MAX_ERROR * max(view.image.shape[1:]))
        good = (found.depth > 0) & (found.error <= largest)
        good &= found.parallax_rad >= MIN_PARALLAX_RAD
        # The error of an inverse depth is the pixel's over the parallax.
        weights = matches.confidence * found.parallax_rad.square()
        return _Points(matches.first[good], found.depth[good], weights[good])


TRIALS = 256
REFINEMENTS = 10
MAD_TO_SIGMA = 1.4826
"""Standard deviation of normal errors whose median absolute value is 1."""
CAUCHY = 2.385
"""Tuning constant: 95 % efficiency where errors are normal (Holland and Welsch, 1977)."""


@dataclass(frozen=True)
class Line:
    """y = slope · x + offset."""

    slope: float
    offset: float

    def __call__(self, x: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
        """y at x."""
        return self.slope * x + self.offset


def robust_line(
    x: Float[Tensor, " n"], y: Float[Tensor, " n"], weights: Float[Tensor, " n"]
) -> Line | None:
    """The line with the least median residual over random pairs (Rousseeuw, 1984), refined by
    reweighted least squares with Cauchy's weights.

    Holds against just under half of the points. None if fewer than two values of x differ. The
    pairs are drawn the same way every time; double precision.
    """
    x, y, weights = (values.detach().double().cpu() for values in (x, y, weights))
    if len(x) < 2:
        return None
    generator = torch.Generator().manual_seed(0)
    ends = torch.multinomial(weights.clamp_min(0) + 1e-12, 2 * TRIALS, True, generator=generator)
    first, second = ends.view(2, TRIALS)
    apart = (x[first] - x[second]).abs() > 1e-9 * x.abs().amax()
    if not apart.any():
        return None
    first, second = first[apart], second[apart]
    slopes = (y[first] - y[second]) / (x[first] - x[second])
    offsets = y[first] - slopes * x[first]
    medians = (y - slopes[:, None] * x - offsets[:, None]).abs().median(-1).values
    best = int(medians.argmin())
    line = Line(float(slopes[best]), float(offsets[best]))
    for _ in range(REFINEMENTS):
        residuals = y - line(x)
        spread = float(residuals.abs().median()) * MAD_TO_SIGMA
        if spread <= 1e-12 * float(y.abs().amax()):
            return line
        trusted = weights / (1 + (residuals / (CAUCHY * spread)).square())
        line = _least_squares(x, y, trusted)
    return line


def _least_squares(
    x: Float[Tensor, " n"], y: Float[Tensor, " n"], weights: Float[Tensor, " n"]
) -> Line:
    share = weights / weights.sum()
    mean_x, mean_y = (share * x).sum(), (share * y).sum()
    slope = (share * (x - mean_x) * (y - mean_y)).sum() / (share * (x - mean_x).square()).sum()
    return Line(float(slope), float(mean_y - slope * mean_x))
