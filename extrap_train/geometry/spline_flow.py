"""Smooth displacement fields on a coarse grid: fitted to scattered displacements, outliers out.

A field is a uniform cubic B-spline with `g × g` control vectors over the image, in normalised
units: as positions, [−1, 1] spans the image, whatever its resolution. Neighbouring control points
are 2 / (g − 3) apart, so that a field bends about that fast and no faster.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from extrap_train.geometry.resample import sample_pixels

STIFFNESS = 1e-5
"""Weight of the field's second differences against one per match: decides only where none are."""
OUTLIER_MADS = 3.0
"""Residuals beyond this many robust standard deviations are not part of a smooth motion."""
MEDIAN_TO_SIGMA = 1 / 1.1774
"""The median length of a residual in the plane is 1.1774 sigma where its two parts are normal."""
MIN_SIGMA = 1e-3
"""Normalised; about a tenth of a pixel at 256². Residuals that small are never outliers."""
ROUNDS = 6


def dense_flow(
    control: Float[Tensor, "*b 2 g g"], height: int, width: int
) -> Float[Tensor, "*b 2 h w"]:
    """The field at the pixel centres."""
    g = control.shape[-1]
    rows, columns = (
        bspline_basis((torch.arange(n, device=control.device) + 0.5) * (2 / n) - 1, g).to(control)
        for n in (height, width)
    )
    return rows @ control @ columns.mT


def flow_at(
    control: Float[Tensor, "2 g g"], positions: Float[Tensor, "n 2"]
) -> Float[Tensor, "n 2"]:
    """The field at normalised (u, v)."""
    across, down = (bspline_basis(p, control.shape[-1]) for p in positions.unbind(-1))
    return torch.einsum("ni,nj,cij->nc", down.to(control), across.to(control), control)


def flow_at_pixels(
    control: Float[Tensor, "2 g g"], pixels: Float[Tensor, "2 n"], height: int, width: int
) -> Float[Tensor, "2 n"]:
    """The field, in pixels, at (u, v) of an image.

    Interpolated between pixel centres: a smooth field allows it, and its splines at every point
    would cost much more.
    """
    field = dense_flow(control, height, width)
    size = pixels.new_tensor([[width], [height]])
    return sample_pixels(field.to(pixels), pixels.mT) * (size / 2)


def bspline_basis(positions: Float[Tensor, " n"], count: int) -> Float[Tensor, "n g"]:
    """Uniform cubic B-splines at positions in [−1, 1] (clamped to it); every row sums to 1."""
    knots = (positions.clamp(-1, 1) + 1) / 2 * (count - 3)
    apart = (knots[:, None] + 1 - torch.arange(count, device=positions.device)).abs()
    near = 2 / 3 - apart.square() * (1 - apart / 2)
    far = (2 - apart).clamp_min(0).pow(3) / 6
    return torch.where(apart < 1, near, far)


def fit_flow(
    positions: Float[Tensor, "n 2"],
    displacements: Float[Tensor, "n 2"],
    weights: Float[Tensor, " n"],
    grid: int,
) -> tuple[Float[Tensor, "2 g g"], Bool[Tensor, " n"]]:
    """The smooth field through most of the displacements, and which of them it believes.

    Weighted least squares with a little stiffness, repeated without the matches whose residual is
    more than `OUTLIER_MADS` robust standard deviations (of the believed ones' median absolute
    deviation). What is believed first comes from a field with the smallest sum of residual
    *lengths* (reweighting), so that one corner full of wrong matches does not bend it.
    """
    if not len(positions):
        raise ValueError("no displacements to fit a field to")
    design = _design(positions, grid)
    target, base = displacements.double(), weights.double()
    bending = STIFFNESS * _second_differences(grid).to(design)
    robust = base
    for _ in range(ROUNDS):
        field = _solve(design, target, robust, bending)
        residual = (target - design @ field).norm(dim=1)
        robust = base / residual.clamp_min(MIN_SIGMA)
    inliers = torch.ones_like(base, dtype=torch.bool)
    for turn in range(ROUNDS):
        sigma = MEDIAN_TO_SIGMA * float(residual[inliers].median())
        kept = residual <= OUTLIER_MADS * max(sigma, MIN_SIGMA)
        if turn and bool((kept == inliers).all()):
            break
        inliers = kept
        field = _solve(design, target, base * inliers, bending)
        residual = (target - design @ field).norm(dim=1)
    return field.T.reshape(2, grid, grid).to(displacements), inliers


def least_squares_flow(
    positions: Float[Tensor, "n 2"],
    displacements: Float[Tensor, "n 2"],
    weights: Float[Tensor, " n"],
    grid: int,
    stiffness: float,
) -> Float[Tensor, "2 g g"]:
    """The field nearest to all of the displacements, as stiff as is asked for."""
    design = _design(positions, grid)
    bending = stiffness * _second_differences(grid).to(design)
    field = _solve(design, displacements.double(), weights.double(), bending)
    return field.T.reshape(2, grid, grid).to(displacements)


def _design(positions: Float[Tensor, "n 2"], grid: int) -> Float[Tensor, "n m"]:
    """Every control point's share of the field at each position."""
    across, down = (bspline_basis(p.double(), grid) for p in positions.unbind(-1))
    return torch.einsum("ni,nj->nij", down, across).flatten(1)


def _solve(
    design: Float[Tensor, "n m"],
    target: Float[Tensor, "n 2"],
    weights: Float[Tensor, " n"],
    bending: Float[Tensor, "m m"],
) -> Float[Tensor, "m 2"]:
    """Weighted least squares; the weights' sum stands for the number of matches."""
    weighted = design * (weights / weights.sum())[:, None]
    normal = weighted.mT @ design + bending
    # Where neither matches nor stiffness decide (a plane through nothing), the smallest field.
    floor = 1e-9 * torch.eye(len(bending), dtype=normal.dtype)
    return torch.linalg.solve(normal + floor, weighted.mT @ target)


def _second_differences(grid: int) -> Float[Tensor, "m m"]:
    """Sum of squared second differences along both axes and across, as a quadratic form."""
    one = torch.eye(grid, dtype=torch.float64)
    first, second = one[1:] - one[:-1], one[2:] - 2 * one[1:-1] + one[:-2]
    parts = (torch.kron(second, one), torch.kron(one, second), torch.kron(first, first))
    return sum((part.mT @ part for part in parts), torch.zeros(grid**2, grid**2).double())
