"""Depth of one view from its neighbours: a plane sweep on a small image, refined on larger ones."""

import math
from dataclasses import dataclass
from itertools import product

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from extrap_train.depth.photo_cost import PhotoCost, projection_between
from extrap_train.depth.plane_sweep_numba import semi_global_numba
from extrap_train.geometry.warp import needs_torch
from extrap_train.views import View

COARSEST_STEP = 2.0
"""Most pixels between two planes in a neighbour: the sweep's image is made as small as needed."""
MIN_SIDE = 64
"""The sweep's image keeps at least this many pixels on its longer side."""
REFINEMENT_STEPS = 3
"""Hypotheses on either side of the estimate that is refined."""


@dataclass(frozen=True)
class Estimate:
    """Depth of one view from matching alone, before it is checked against other views."""

    inverse_depth: Float[Tensor, "h w"]
    correlation: Float[Tensor, "h w"]
    """Correlation of the windows, from 0 (no better than chance, or no texture) to 1."""


def sweep(view: View, neighbours: list[View], bounds: tuple[float, float], planes: int) -> Estimate:
    """Estimate the view's inverse depth within `bounds`, at the view's resolution."""
    step = (bounds[1] - bounds[0]) / (planes - 1)
    halvings = _halvings(view, neighbours, step, bounds)
    small, small_neighbours = _halve(view, halvings), [_halve(n, halvings) for n in neighbours]
    hypotheses = torch.linspace(*bounds, planes, device=view.image.device)
    shape = (planes, small.camera.height, small.camera.width)
    cost = PhotoCost(small, small_neighbours)(hypotheses[:, None, None].expand(shape))
    cost = semi_global_cost(cost, small.image)
    inverse_depth = bounds[0] + step * _best_index(cost)[0]
    width = step
    for halving in range(halvings, -1, -1):
        level, others = _halve(view, halving), [_halve(n, halving) for n in neighbours]
        estimate = _refine(level, others, inverse_depth, width / 2, bounds)
        inverse_depth, width = estimate.inverse_depth, width / 2
    return estimate


def _refine(
    view: View,
    neighbours: list[View],
    start: Float[Tensor, "h w"],
    step: float,
    bounds: tuple[float, float],
) -> Estimate:
    size = (view.camera.height, view.camera.width)
    start = _median(functional.interpolate(start[None, None], size, mode="nearest-exact")[0, 0])
    offsets = step * torch.arange(-REFINEMENT_STEPS, REFINEMENT_STEPS + 1, device=start.device)
    cost = PhotoCost(view, neighbours)((start + offsets[:, None, None]).clamp(*bounds))
    index, least = _best_index(cost)
    found = start + step * (index - REFINEMENT_STEPS)
    return Estimate(found.clamp(*bounds), (1 - 2 * least).clamp(0, 1))


def _best_index(cost: Float[Tensor, "d h w"]) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
    """Index of the least cost, by a parabola through it and its neighbours; and that cost."""
    least, best = cost.min(0)
    inner = best.clamp(1, len(cost) - 2)[None]
    before, middle, after = (cost.gather(0, inner + i)[0] for i in (-1, 0, 1))
    curvature = (before - 2 * middle + after).clamp_min(1e-6)
    shift = ((before - after) / (2 * curvature)).clamp(-0.5, 0.5)
    return torch.where(best == inner[0], best + shift, best.to(cost.dtype)), least


def _median(depth: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """3 × 3 median: removes lone outliers, keeps edges."""
    padded = functional.pad(depth[None, None], (1, 1, 1, 1), mode="replicate")
    windows = padded[0, 0].unfold(0, 3, 1).unfold(1, 3, 1).flatten(-2)
    return windows.median(-1).values


def _halve(view: View, times: int) -> View:
    if times == 0:
        return view
    return view.resized(
        max(1, round(view.camera.height / 2**times)), max(1, round(view.camera.width / 2**times))
    )


def _halvings(view: View, neighbours: list[View], step: float, bounds: tuple[float, float]) -> int:
    """How often to halve the image so that neighbouring planes lie about a pixel apart."""
    longer = max(view.camera.height, view.camera.width)
    allowed = max(0, int(math.log2(longer / MIN_SIDE)))
    spacing = _plane_spacing(view, neighbours, step, bounds)
    if not 0 < spacing < math.inf:  # no neighbour sees the planes move: the matching says so
        return 0
    return min(max(math.ceil(math.log2(spacing / COARSEST_STEP)), 0), allowed)


def _plane_spacing(
    view: View, neighbours: list[View], step: float, bounds: tuple[float, float]
) -> float:
    """Median displacement between two planes, in pixels."""
    camera = view.camera.resized(8, 8)
    middle = torch.full((8, 8), sum(bounds) / 2, device=view.image.device)
    spacings = []
    for other in neighbours:
        projection = projection_between(camera, other.camera)
        moved = projection.points(middle + step)[0] - projection.points(middle)[0]
        spacings.append(moved.norm(dim=-1).median())
    return float(torch.stack(spacings).median())


SMALL_STEP = 0.03
"""Penalty of a change by one hypothesis between neighbouring pixels (cost is in [0, 1])."""
JUMP = 0.6
"""Penalty of a larger change within one colour; it falls where colour changes."""
PATHS_AT_A_TIME = 4
"""Directions that are summed in parallel on the CPU; each takes as much memory as the cost."""
EDGE_CONTRAST = 0.05
"""Colour difference that halves the penalty of a jump."""


def semi_global_cost(
    cost: Float[Tensor, "d h w"], image: Float[Tensor, "3 h w"]
) -> Float[Tensor, "d h w"]:
    """Least cost of a path of hypotheses that ends in each pixel, mean of eight directions.

    Semi-global matching (Hirschmüller, 2008).
    """
    if needs_torch(cost, image):
        return semi_global_torch(cost, image)
    planes_last = cost.permute(1, 2, 0).contiguous()
    steps = [step for step in product((-1, 0, 1), repeat=2) if step != (0, 0)]
    penalties = torch.stack([_jump_penalty(image, *step) for step in steps])
    totals = cost.new_zeros(PATHS_AT_A_TIME, *planes_last.shape)
    semi_global_numba(
        planes_last.numpy(),
        penalties.numpy(),
        np.array(steps),
        np.float32(SMALL_STEP),
        totals.numpy(),
    )
    return totals.sum(0).permute(2, 0, 1) / len(steps)


def semi_global_torch(
    cost: Float[Tensor, "d h w"], image: Float[Tensor, "3 h w"]
) -> Float[Tensor, "d h w"]:
    """`semi_global_cost` in torch, for GPUs: vectorised over scanlines."""
    rows = cost.permute(1, 2, 0)
    columns, image_columns = cost.permute(2, 1, 0), image.mT
    down = torch.stack([_both_ways(rows, image, shift) for shift in (-1, 0, 1)]).sum(0)
    across = _both_ways(columns, image_columns, 0)
    return (down.permute(2, 0, 1) + across.permute(2, 1, 0)) / 8


def _both_ways(
    cost: Float[Tensor, "n lanes d"], image: Float[Tensor, "3 n lanes"], shift: int
) -> Float[Tensor, "n lanes d"]:
    """Paths that step by (1, shift), and those that step by (−1, −shift), added."""
    penalty = _jump_penalty(image, 1, shift)[..., None]
    backward = _jump_penalty(image.flip(1, 2), 1, shift)[..., None]
    costs = torch.stack([cost, cost.flip(0, 1)], 1)
    forward_sum, backward_sum = _scan(costs, torch.stack([penalty, backward], 1), shift).unbind(1)
    return forward_sum + backward_sum.flip(0, 1)


def _scan(
    cost: Float[Tensor, "n 2 lanes d"], penalty: Float[Tensor, "n 2 lanes 1"], shift: int
) -> Float[Tensor, "n 2 lanes d"]:
    total = torch.empty_like(cost)
    total[0] = path = cost[0]
    for i in range(1, len(cost)):
        before = _shift(path, shift)
        least = before.amin(-1, keepdim=True)
        ends = functional.pad(before, (1, 1), value=torch.inf)
        step = torch.minimum(ends[..., 2:], ends[..., :-2]).add_(SMALL_STEP)
        kept = torch.minimum(torch.minimum(before, step), least + penalty[i])
        total[i] = path = kept.sub_(least).add_(cost[i])
    return total


def _shift(path: Float[Tensor, "2 lanes d"], shift: int) -> Float[Tensor, "2 lanes d"]:
    """Every lane's predecessor; a lane without one starts a path."""
    if shift == 0:
        return path
    return functional.pad(path, (0, 0, 1, -1) if shift > 0 else (0, 0, -1, 1))


def _jump_penalty(
    image: Float[Tensor, "3 h w"], row_step: int, column_step: int
) -> Float[Tensor, "h w"]:
    """The penalty for a jump on a path that comes to each pixel by this step."""
    contrast = (image - image.roll((row_step, column_step), (1, 2))).abs().mean(0)
    return (JUMP / (1 + contrast / EDGE_CONTRAST)).clamp_min(1.5 * SMALL_STEP)
