"""The depth that a source measures of a new picture, and how far the map bears it out."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from extrap_train.depth import RELIABLE_CONFIDENCE, DepthSource
from extrap_train.errors import InputError
from extrap_train.geometry.alignment import Edges, align_view
from extrap_train.geometry.cameras import unproject_to_world
from extrap_train.reconstruction.global_map import GlobalMap, Prior
from extrap_train.views import View


@dataclass(frozen=True)
class Measured:
    """A new view's depth from the point maps of its edges, aligned to the map."""

    depth: Float[Tensor, "h w"]
    confidence: Float[Tensor, "h w"]
    """0 to 1."""
    reliable: Bool[Tensor, "h w"]
    """Where the source itself is sure enough for its depth to be used."""
    edges: Int[Tensor, "h w"]
    """Edges that measure a pixel."""
    usable_edges: int
    """Known views that the new one could be aligned to."""


def measure(
    scene_map: GlobalMap, picture: View, indices: Sequence[int], source: DepthSource
) -> Measured:
    """Depth from the source's point maps of the new view with each of these known ones."""
    maps, worlds, depths = [], [], []
    for index in indices:
        other = scene_map.views[index]
        try:
            maps.append(source.point_maps(picture, other.view))
        except InputError:
            continue  # the source cannot pair these two; the count of edges is reported
        worlds.append(unproject_to_world(other.depth, other.camera).flatten(0, 1))
        depths.append((other.confidence >= RELIABLE_CONFIDENCE).flatten())
    if not maps:
        nothing = torch.zeros(picture.camera.height, picture.camera.width)
        return Measured(nothing, nothing, nothing.bool(), nothing.int(), 0)
    edges = Edges(
        new_points=torch.stack([m.first for m in maps]),
        new_confidence=torch.stack([_reliable(m.first_confidence) for m in maps]),
        known_points=torch.stack([m.second.flatten(0, 1) for m in maps]),
        known_confidence=torch.stack([_reliable(m.second_confidence).flatten() for m in maps]),
        world_points=torch.stack(worlds),
        world_known=torch.stack(depths),
    )
    aligned = align_view(picture.camera, edges)
    confidence = aligned.confidence.clamp(max=1)
    measuring = (edges.new_confidence > 0) & aligned.usable[:, None, None]
    return Measured(
        aligned.depth,
        confidence,
        (aligned.depth > 0) & (confidence >= RELIABLE_CONFIDENCE),
        measuring.sum(0).int(),
        int(aligned.usable.sum()),
    )


def confirmed(
    measured: Measured, prior: Prior, tolerance: float
) -> tuple[Bool[Tensor, "h w"], Bool[Tensor, "h w"]]:
    """Where the map shows the surface that was measured, and where it shows a reliable one."""
    testable = measured.reliable & (prior.confidence >= RELIABLE_CONFIDENCE)
    agrees = depth_difference(prior.depth, measured.depth) <= 2 * tolerance
    return agrees & testable, testable


def supported(measured: Measured, prior: Prior, possible_edges: int, tolerance: float) -> Measured:
    """The confidence times what confirms it, 1 at best; which pixels are reliable stays.

    For the whole view that is the share of its reliable pixels that the map could test and
    confirms: what is wrong where it can be tested is likely to be wrong elsewhere, and of a view of
    which little can be tested little is known. For a pixel it is how many edges measure it, against
    one imagined that contradicts: n/(n + 1), as a share of what all `possible_edges` would reach.
    An edge that stands alone cannot but agree with itself.
    """
    agrees, _ = confirmed(measured, prior, tolerance)
    share = agrees.sum() / measured.reliable.sum().clamp(min=1)
    fullest = possible_edges / (possible_edges + 1)
    by_edges = measured.edges / (measured.edges + 1) / fullest
    return replace(measured, confidence=measured.confidence * share * by_edges)


def depth_difference(
    one: Float[Tensor, "h w"], other: Float[Tensor, "h w"]
) -> Float[Tensor, "h w"]:
    """Difference of depth as a share of the nearer one; infinite where either is unknown."""
    nearer, farther = torch.minimum(one, other), torch.maximum(one, other)
    return torch.where(nearer > 0, farther / nearer.clamp(min=1e-30) - 1, torch.inf)


def _reliable(confidence: Tensor) -> Tensor:
    return torch.where(confidence >= RELIABLE_CONFIDENCE, confidence, 0)
