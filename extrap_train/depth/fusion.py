"""One depth map from several estimates of the same view."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.depth import DepthMap

SAME_DEPTH = math.log(1.05)
"""Estimates whose logarithms differ by more mean different surfaces."""


def fuse_depth_maps(estimates: Sequence[DepthMap]) -> DepthMap:
    """The confidence-weighted median of each pixel, then the mean of the estimates that agree.

    Confidence is the mean of those that agree times their share of the weight. Unknown where all
    are. One estimate stays as it is.
    """
    depths = torch.stack([estimate.depth for estimate in estimates])
    weights = torch.stack([estimate.confidence for estimate in estimates]) * (depths > 0)
    logs = depths.clamp_min(1e-30).log()
    agree = weights * ((logs - weighted_median(logs, weights)).abs() <= SAME_DEPTH)
    total, known = weights.sum(0), agree.sum(0)
    safe = known.clamp_min(1e-12)
    mean = ((logs * agree).sum(0) / safe).exp()
    confidence = agree.square().sum(0) / safe * known / total.clamp_min(1e-12)
    return DepthMap(torch.where(known > 0, mean, 0), torch.where(known > 0, confidence, 0))


def weighted_median(
    values: Float[Tensor, "k ..."], weights: Float[Tensor, "k ..."]
) -> Float[Tensor, "*n"]:
    """The least value that, with all below it, has half the weight; anything where that is 0."""
    order = values.argsort(0)
    heights = weights.gather(0, order).cumsum(0)
    middle = (heights < heights[-1:] / 2).sum(0, keepdim=True).clamp_max(len(values) - 1)
    return values.gather(0, order).gather(0, middle)[0]
