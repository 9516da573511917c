"""A picture becomes a view of the map: aligned to known views, checked against the map, completed
where nothing measures it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from extrap_train.config import ConfidenceConfig
from extrap_train.depth import DepthSource
from extrap_train.geometry.cameras import unproject_to_world
from extrap_train.geometry.ncc import ncc_consistent
from extrap_train.reconstruction.continuation import continued_depth
from extrap_train.reconstruction.depth_prediction.inference import DepthPredictor
from extrap_train.reconstruction.global_map import (
    MAX_COMPARED,
    GlobalMap,
    Prior,
    Sight,
    look_up,
    prior_of,
)
from extrap_train.reconstruction.measurement import (
    Measured,
    confirmed,
    depth_difference,
    measure,
    supported,
)
from extrap_train.views import Camera, View

CONTINUED_CONFIDENCE = 0.15
"""Confidence of depth that nothing measures."""
PREDICTED_CONFIDENCE = 0.7
"""Highest confidence of predicted depth: below what stereo measures."""
CONTRADICTED = 0.9
"""Factor on the confidence of a pixel whose two depths differ."""
AS_SURE = 1e-3
"""Confidences that differ by less count as equal, since warping rounds them."""


@dataclass(frozen=True)
class Proposal:
    """A view as it would enter the map."""

    view: View
    confidence: Float[Tensor, "h w"]
    agreement: float
    """Share of the testable pixels whose picture and depth agree with the map: the lesser one; 0
    where nothing can be tested, for what nobody confirms may be anything.
    """
    edges: int
    """Known views that it could be aligned to."""


def propose(
    scene_map: GlobalMap,
    picture: View,
    indices: Sequence[int],
    source: DepthSource,
    options: ConfidenceConfig,
) -> Proposal:
    """Give a picture, posed and without depth, its depth and confidence.

    `indices` are the map's views that it is aligned to, nearest first. Everything that is known
    stays as it is.
    """
    prior = prior_of(scene_map, picture.camera, indices)
    measured = measure(scene_map, picture, indices, source)
    agreement = _agreement(picture, prior, measured, scene_map.tolerance)
    if options.support:
        measured = supported(measured, prior, len(indices), scene_map.tolerance)
    contradicted = None
    if options.repair:
        contradicted = _contradicted(scene_map, picture.camera, prior, measured)
    depth, confidence = _fused(prior, measured, scene_map.tolerance, contradicted)
    distrust = partial(_distrusted, scene_map, picture.camera, agreement, options)
    dropped = (depth > 0) & ~prior.mask & distrust(depth, confidence)
    depth, confidence = (torch.where(dropped, 0, x) for x in (depth, confidence))
    filled = continued_depth(depth, picture.image)
    continued = (depth == 0) & (filled > 0)
    confidence = torch.where(continued, CONTINUED_CONFIDENCE, confidence)
    confidence = torch.where(continued & distrust(filled, confidence), 0, confidence)
    view = replace(picture, depth=torch.where(confidence > 0, filled, 0))
    return Proposal(view, confidence, agreement, measured.usable_edges)


def propose_predicted(
    scene_map: GlobalMap,
    picture: View,
    indices: Sequence[int],
    predictor: DepthPredictor,
    options: ConfidenceConfig,
) -> Proposal:
    """Give a picture, posed and without depth, its predicted depth.

    Where the map is certain, its depth is kept. Elsewhere the predicted depth enters with its own
    confidence, scaled to stay below a photograph's. What the map shows only through unobserved
    space neither confirms the view nor contradicts it.
    """
    prior = prior_of(scene_map, picture.camera, indices)
    found = predictor(scene_map, picture, indices)
    certain = found.certain & prior.mask
    agrees, testable = ncc_consistent(picture.image, prior.image, certain)
    agreement = float(agrees.sum() / testable.sum()) if testable.any() else 0.0
    depth = torch.where(certain, prior.depth, found.depth)
    confidence = torch.where(certain, prior.confidence, PREDICTED_CONFIDENCE * found.confidence)
    confidence = torch.where(depth > 0, confidence, 0)
    distrusted = _distrusted(scene_map, picture.camera, agreement, options, depth, confidence)
    confidence = torch.where(~certain & distrusted, 0, confidence)
    depth = torch.where(confidence > 0, depth, 0)
    return Proposal(replace(picture, depth=depth), confidence, agreement, len(indices))


def _distrusted(
    scene_map: GlobalMap,
    camera: Camera,
    agreement: float,
    options: ConfidenceConfig,
    depth: Float[Tensor, "h w"],
    confidence: Float[Tensor, "h w"],
) -> Bool[Tensor, "h w"]:
    """Pixels that need the map's backing: all of a view that contradicts the map, and of any other
    view those in space that a more certain view has seen to be empty.
    """
    if options.reject and agreement < options.least_agreement:
        return torch.ones_like(depth, dtype=torch.bool)
    if options.free_space:
        return _seen_through(scene_map, depth, confidence, camera)
    return torch.zeros_like(depth, dtype=torch.bool)


def _agreement(picture: View, prior: Prior, measured: Measured, tolerance: float) -> float:
    """Share of testable pixels that agree, by picture and by depth: the lesser one; 0 without any
    testable pixel.
    """
    by_picture = ncc_consistent(picture.image, prior.image, prior.mask)
    by_depth = confirmed(measured, prior, tolerance)
    shares = [
        float(agrees.sum() / testable.sum())
        for agrees, testable in (by_picture, by_depth)
        if testable.any()
    ]
    return min(shares, default=0.0)


def _contradicted(
    scene_map: GlobalMap, camera: Camera, prior: Prior, measured: Measured
) -> Bool[Tensor, "h w"]:
    """Where the map knows better: it has a surface in front of the measured one, or has looked
    through the measured one. In front of what it shows, a new surface contradicts nothing.
    """
    no_less_sure = prior.confidence > measured.confidence - AS_SURE
    looked_through = _seen_through(scene_map, measured.depth, measured.confidence, camera)
    return no_less_sure & ((measured.depth > prior.depth) | looked_through)


def _fused(
    prior: Prior,
    measured: Measured,
    tolerance: float,
    contradicted: Bool[Tensor, "h w"] | None,
) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
    """One depth from the map's and the measured one, and its confidence; 0 where neither is.

    Where both agree, their weighted mean; where they do not, the map's where it contradicts what
    was measured.
    """
    same = (
        measured.reliable
        & prior.mask
        & (depth_difference(prior.depth, measured.depth) <= tolerance)
    )
    total = (prior.confidence + measured.confidence).clamp(min=1e-6)
    mean = (prior.confidence * prior.depth + measured.confidence * measured.depth) / total
    from_map = prior.mask & ~measured.reliable
    if contradicted is not None:
        from_map |= prior.mask & contradicted
    differ = measured.reliable & prior.mask & ~same
    depth = torch.where(from_map, prior.depth, torch.where(measured.reliable, measured.depth, 0))
    confidence = torch.where(from_map, prior.confidence, measured.confidence)
    confidence = torch.where(differ, CONTRADICTED * confidence, confidence)
    depth = torch.where(same, mean, depth)
    confidence = torch.where(same, torch.maximum(prior.confidence, measured.confidence), confidence)
    known = (depth > 0) & (confidence > 0)
    return torch.where(known, depth, 0), torch.where(known, confidence, 0)


def _seen_through(
    scene_map: GlobalMap,
    depth: Float[Tensor, "h w"],
    confidence: Float[Tensor, "h w"],
    camera: Camera,
) -> Bool[Tensor, "h w"]:
    """Pixels whose point lies in front of what a more certain view has seen behind it."""
    points = unproject_to_world(depth, camera).flatten(0, 1)
    found = torch.zeros(len(points), dtype=torch.bool)
    for index in scene_map.nearest(camera, MAX_COMPARED):
        other = scene_map.views[index]
        said = look_up(points, other.depth, other.camera, 2 * scene_map.tolerance)
        more_certain = other.confidence.flatten()[said.pixel] > confidence.flatten() + AS_SURE
        found |= (said.sight == Sight.IN_FRONT) & more_certain
    return found.view_as(depth) & (depth > 0)
