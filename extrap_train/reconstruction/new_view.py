"""A picture becomes a view of the map: aligned to known views, checked against the map, completed
where nothing measures it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from extrap_train.config import ConfidenceConfig
from extrap_train.depth import RELIABLE_CONFIDENCE, DepthSource
from extrap_train.errors import InputError
from extrap_train.geometry.alignment import Edges, align_view
from extrap_train.geometry.cameras import unproject_to_world
from extrap_train.geometry.warp import warp_references
from extrap_train.reconstruction.agreement import Sight, look_up
from extrap_train.reconstruction.continuation import continued_depth
from extrap_train.reconstruction.global_map import MOST_COMPARED, GlobalMap
from extrap_train.reconstruction.likeness import alike
from extrap_train.views import Camera, View, stack_cameras

CONTINUED_CONFIDENCE = 0.15
"""Of depth that nothing measures."""
CONTRADICTED = 0.9
"""Factor on the confidence of a pixel whose two depths differ."""


@dataclass(frozen=True)
class Prior:
    """What the map shows of a camera's picture; zero where it shows nothing."""

    image: Float[Tensor, "3 h w"]
    depth: Float[Tensor, "h w"]
    confidence: Float[Tensor, "h w"]

    @property
    def mask(self) -> Bool[Tensor, "h w"]:
        """Where the map shows anything."""
        return self.depth > 0


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


def prior_of(known: GlobalMap, camera: Camera, indices: Sequence[int]) -> Prior:
    """The map's picture, depth and confidence for a camera, from some of its views."""
    views = [known.views[index] for index in indices]
    cameras = stack_cameras([stack_cameras([view.camera for view in views])])
    depths = torch.stack([view.depth for view in views])[None]
    valid = torch.ones(1, len(views), dtype=torch.bool)
    query = stack_cameras([camera])
    images = torch.stack([view.view.image for view in views])[None]
    warp = warp_references(images, depths, cameras, valid, query)
    confidence = torch.stack([view.confidence.expand(3, -1, -1) for view in views])[None]
    carried = warp_references(confidence.contiguous(), depths, cameras, valid, query)
    return Prior(warp.image[0], warp.depth[0] * warp.mask[0], carried.image[0, 0])


def propose(
    known: GlobalMap,
    picture: View,
    indices: Sequence[int],
    source: DepthSource,
    options: ConfidenceConfig,
) -> Proposal:
    """Give a picture, posed and without depth, its depth and confidence.

    `indices` are the map's views that it is aligned to, nearest first. Everything that is known
    stays as it is.
    """
    prior = prior_of(known, picture.camera, indices)
    measured, edges = _measured(known, picture, indices, source)
    agreement = _agreement(picture, prior, measured, known.tolerance)
    kept = _contradicted(known, picture.camera, prior, measured) if options.repair else None
    depth, confidence = _fused(prior, measured, known.tolerance, kept)
    unbacked = (depth > 0) & ~prior.mask
    if options.reject and agreement < options.least_agreement:
        depth, confidence = (torch.where(unbacked, 0, x) for x in (depth, confidence))
    elif options.free_space:
        seen_through = _seen_through(known, depth, confidence, picture.camera)
        depth, confidence = (
            torch.where(unbacked & seen_through, 0, x) for x in (depth, confidence)
        )
    completed = continued_depth(depth, picture.image)
    continued = (depth == 0) & (completed > 0)
    confidence = torch.where(continued, CONTINUED_CONFIDENCE, confidence)
    if options.reject and agreement < options.least_agreement:
        confidence = torch.where(continued, 0, confidence)
    elif options.free_space:
        seen_through = _seen_through(known, completed, confidence, picture.camera)
        confidence = torch.where(continued & seen_through, 0, confidence)
    completed = torch.where(confidence > 0, completed, 0)
    view = replace(picture, depth=completed)
    return Proposal(view, confidence, agreement, edges)


@dataclass(frozen=True)
class _Measured:
    depth: Float[Tensor, "h w"]
    confidence: Float[Tensor, "h w"]

    @property
    def reliable(self) -> Bool[Tensor, "h w"]:
        return (self.depth > 0) & (self.confidence >= RELIABLE_CONFIDENCE)


def _measured(
    known: GlobalMap, picture: View, indices: Sequence[int], source: DepthSource
) -> tuple[_Measured, int]:
    """Depth from the source's point maps of the new view with each known one, aligned."""
    maps, worlds, depths = [], [], []
    for index in indices:
        other = known.views[index]
        try:
            maps.append(source.point_maps(picture, other.view))
        except InputError:
            continue  # the source cannot pair these two; the count of edges is reported
        worlds.append(unproject_to_world(other.depth, other.camera).flatten(0, 1))
        depths.append((other.confidence >= RELIABLE_CONFIDENCE).flatten())
    if not maps:
        nothing = torch.zeros(picture.camera.height, picture.camera.width)
        return _Measured(nothing, nothing), 0
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
    return _Measured(aligned.depth, confidence), int(aligned.usable.sum())


def _reliable(confidence: Tensor) -> Tensor:
    return torch.where(confidence >= RELIABLE_CONFIDENCE, confidence, 0)


def _agreement(picture: View, prior: Prior, measured: _Measured, tolerance: float) -> float:
    """Share of testable pixels that agree, by picture and by depth: the lesser one; 0 without any
    testable pixel.
    """
    same, comparable = alike(picture.image, prior.image, prior.mask)
    shares = [float(same.sum() / comparable.sum().clamp(min=1))] if comparable.any() else []
    tested = measured.reliable & (prior.confidence >= RELIABLE_CONFIDENCE)
    if tested.any():
        agrees = _differ(prior.depth, measured.depth) <= 2 * tolerance
        shares.append(float((agrees & tested).sum() / tested.sum()))
    return min(shares, default=0.0)


def _differ(one: Float[Tensor, "h w"], other: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Difference of depth as a share of the nearer one; infinite where either is unknown."""
    nearer, farther = torch.minimum(one, other), torch.maximum(one, other)
    return torch.where(nearer > 0, farther / nearer.clamp(min=1e-30) - 1, torch.inf)


def _contradicted(
    known: GlobalMap, camera: Camera, prior: Prior, measured: _Measured
) -> Bool[Tensor, "h w"]:
    """Where the map knows better: it has a surface in front of the measured one, or has looked
    through the measured one. In front of what it shows, a new surface contradicts nothing.
    """
    surer = prior.confidence >= measured.confidence
    looked_through = _seen_through(known, measured.depth, measured.confidence, camera)
    return surer & ((measured.depth > prior.depth) | looked_through)


def _fused(
    prior: Prior,
    measured: _Measured,
    tolerance: float,
    contradicted: Bool[Tensor, "h w"] | None,
) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
    """One depth from the map's and the measured one, and its confidence; 0 where neither is.

    Where both agree, their weighted mean; where they do not, the map's where it contradicts what
    was measured.
    """
    same = measured.reliable & prior.mask & (_differ(prior.depth, measured.depth) <= tolerance)
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
    return depth, torch.where(depth > 0, confidence, 0)


def _seen_through(
    known: GlobalMap,
    depth: Float[Tensor, "h w"],
    confidence: Float[Tensor, "h w"],
    camera: Camera,
) -> Bool[Tensor, "h w"]:
    """Pixels whose point lies in front of what a surer view has seen behind it."""
    points = unproject_to_world(depth, camera).flatten(0, 1)
    found = torch.zeros(len(points), dtype=torch.bool)
    for index in known.nearest(camera, MOST_COMPARED):
        other = known.views[index]
        said = look_up(points, other.depth, other.camera, 2 * known.tolerance)
        surer = other.confidence.flatten()[said.pixel] > confidence.flatten()
        found |= (said.sight == Sight.IN_FRONT) & surer
    return found.view_as(depth) & (depth > 0)


def scene_size(cameras: Camera, center: Float[Tensor, "3"]) -> float:
    """Width of the pictures at the scene's centre, in scene units: the unit of drift."""
    z = cameras.world_to_cam[:, 2, :3] @ center + cameras.world_to_cam[:, 2, 3]
    width = z * cameras.width / cameras.intrinsics[:, 0, 0]
    size = float(width.median())
    assert math.isfinite(size)
    return size
