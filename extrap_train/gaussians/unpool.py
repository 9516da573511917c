"""Proximity-guided unpooling (FSGS, section 3.2): new Gaussians half-way to far neighbours."""

from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from extrap_train.gaussians.parameters import (
    GaussianParameters,
    from_tensors,
    nearest_neighbours,
)

NEIGHBOURS = 3

Pairing = Literal["paper", "released"]


def unpooled(
    parameters: GaussianParameters, proximity: float, scale: float, pairing: Pairing, most: int
) -> tuple[GaussianParameters, bool]:
    """The Gaussians that fill the gaps between those already there, the most isolated sources'
    first and at most `most` of them; and whether there would have been more.

    A Gaussian is a source where the mean squared distance to its three neighbours exceeds
    `proximity` and its largest scale `scale`. On each edge from a source to a neighbour a new one
    is put in the middle, with the neighbour's scale and opacity, no rotation, and a colour of zero.
    `released` pairs as the published code does: sources repeat as 0 1 0 1 0 1 while neighbours
    stand as 0 0 0 1 1 1, so that with several sources most edges lead to a stranger.
    """
    distance, index = nearest_neighbours(parameters.means, NEIGHBOURS)
    gap = distance.square().mean(1)
    sources = isolated(parameters, gap, proximity, scale)
    source, target = edges(sources, index, pairing)
    limited = len(source) > most
    source, target = source[:most], target[:most]
    means = parameters.means.detach()
    count = len(source)
    quats = torch.zeros(count, 4).to(means)
    quats[:, 0] = 1
    new = from_tensors(
        {
            "means": (means[source] + means[target]) / 2,
            "log_scales": parameters.log_scales.detach()[target],
            "quats": quats,
            "opacity_logits": parameters.opacity_logits.detach()[target],
            "sh_dc": torch.zeros_like(parameters.sh_dc[target]),
            "sh_rest": torch.zeros_like(parameters.sh_rest[target]),
        }
    )
    return new, limited


def isolated(
    parameters: GaussianParameters, gap: Float[Tensor, " n"], proximity: float, scale: float
) -> Int[Tensor, " s"]:
    """Numbers of the Gaussians that are large and far from their neighbours, farthest first."""
    chosen = (gap > proximity) & (parameters.scales.detach().amax(1) > scale)
    order = gap.argsort(descending=True, stable=True)
    return order[chosen[order]]


def edges(
    sources: Int[Tensor, " s"], neighbours: Int[Tensor, "n k"], pairing: Pairing
) -> tuple[Int[Tensor, " m"], Int[Tensor, " m"]]:
    """Both ends of every new edge, as Gaussian numbers."""
    targets = neighbours[sources].flatten()
    count = neighbours.shape[1]
    if pairing == "paper":
        return sources.repeat_interleave(count), targets
    return sources.repeat(count), targets
