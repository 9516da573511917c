"""Proximity-guided unpooling (FSGS, section 3.2): new Gaussians half-way to far neighbours."""

from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from benchmarks.methods.gaussians.parameters import (
    GaussianParameters,
    from_tensors,
    nearest_neighbours,
)

NEIGHBOURS = 3

Pairing = Literal["paper", "released"]


def unpooled(
    parameters: GaussianParameters, proximity: float, scale: float, pairing: Pairing, most: int
) -> GaussianParameters:
    """The Gaussians that fill the gaps between those already there; at most `most` of them.

    A Gaussian is a source where the mean squared distance to its three neighbours exceeds
    `proximity` and its largest scale `scale`. On each edge from a source to a neighbour a new one
    is put in the middle, with the neighbour's scale and opacity, no rotation, and a colour of zero.
    `released` pairs as the published code does: sources repeat as 0 1 0 1 0 1 while neighbours
    stand as 0 0 0 1 1 1, so that with several sources most edges lead to a stranger.
    """
    distance, index = nearest_neighbours(parameters.means, NEIGHBOURS)
    sources = isolated(parameters, distance, proximity, scale)
    source, target = edges(sources, index, pairing)
    source, target = source[:most], target[:most]
    means = parameters.means.detach()
    count = len(source)
    quats = torch.zeros(count, 4).to(means)
    quats[:, 0] = 1
    return from_tensors(
        {
            "means": (means[source] + means[target]) / 2,
            "log_scales": parameters.log_scales.detach()[target],
            "quats": quats,
            "opacity_logits": parameters.opacity_logits.detach()[target],
            "sh_dc": torch.zeros_like(parameters.sh_dc[target]),
            "sh_rest": torch.zeros_like(parameters.sh_rest[target]),
        }
    )


def isolated(
    parameters: GaussianParameters,
    distance: Float[Tensor, "n k"],
    proximity: float,
    scale: float,
) -> Bool[Tensor, "n"]:
    """Which Gaussians are large and far from their neighbours."""
    far = distance.square().mean(1) > proximity
    return far & (parameters.scales.detach().amax(1) > scale)


def edges(
    sources: Bool[Tensor, "n"], neighbours: Int[Tensor, "n k"], pairing: Pairing
) -> tuple[Int[Tensor, "m"], Int[Tensor, "m"]]:
    """Both ends of every new edge, as Gaussian numbers."""
    number = sources.nonzero()[:, 0]
    targets = neighbours[number].flatten()
    count = neighbours.shape[1]
    if pairing == "paper":
        return number.repeat_interleave(count), targets
    return number.repeat(count), targets
