"""Semi-global matching (Hirschmüller, Stereo Processing by Semiglobal Matching and Mutual
Information, 2008), vectorised over scanlines."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

SMALL_STEP = 0.03
"""Penalty of a change by one hypothesis between neighbouring pixels (cost is in [0, 1])."""
JUMP = 0.6
"""Penalty of a larger change within one colour; it falls where colour changes."""
EDGE_CONTRAST = 0.05
"""Colour difference that halves the penalty of a jump."""


def semi_global_cost(
    cost: Float[Tensor, "d h w"], image: Float[Tensor, "3 h w"]
) -> Float[Tensor, "d h w"]:
    """Least cost of a path of hypotheses that ends in each pixel, mean of eight directions."""
    rows = cost.permute(1, 2, 0)
    columns, image_columns = cost.permute(2, 1, 0), image.mT
    down = torch.stack([_both_ways(rows, image, shift) for shift in (-1, 0, 1)]).sum(0)
    across = _both_ways(columns, image_columns, 0)
    return (down.permute(2, 0, 1) + across.permute(2, 1, 0)) / 8


def _both_ways(
    cost: Float[Tensor, "n lanes d"], image: Float[Tensor, "3 n lanes"], shift: int
) -> Float[Tensor, "n lanes d"]:
    """Paths that step by (1, shift), and those that step by (−1, −shift), added."""
    penalty = _jump_penalty(image, shift)
    backward = _jump_penalty(image.flip(1, 2), shift)
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


def _jump_penalty(image: Float[Tensor, "3 n lanes"], shift: int) -> Float[Tensor, "n lanes 1"]:
    contrast = (image - image.roll((1, shift), (1, 2))).abs().mean(0)
    return (JUMP / (1 + contrast / EDGE_CONTRAST)).clamp_min(1.5 * SMALL_STEP)[..., None]
