"""A straight line through points of which many are wrong."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

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
