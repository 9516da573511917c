"""What is known of a view before it has a depth: the input of the depth network."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from extrap_train.geometry.resample import fill_holes
from extrap_train.geometry.visibility import Ball, trace_visibility
from extrap_train.geometry.warp import warp_references
from extrap_train.views import Camera

CHANNELS = 19
ENTRY, CERTAIN, MEASURED = 10, 14, 15
"""Channels that others read: where the network's answer starts, and where it is known."""
MAX_UNOBSERVED = 0.04
"""In radii of the ball: with more unobserved space in front of it, a warped surface is a
hypothesis."""
FARTHEST = 2.0
"""Bound of log depths, in which the scene's centre lies at 0."""
_MIN_RATIO = 0.05


@dataclass(frozen=True)
class Observation:
    """Log depths are relative to the depth of the scene's centre, so nothing has a unit."""

    features: Float[Tensor, "b c h w"]
    """`MEASURED`: log depth that the depth source measured; where it found nothing, the certain
    warp's, holes filled smoothly. `ENTRY`: log depth at which the ray enters unobserved space; the
    filled warp's where it never does."""
    center_depth: Float[Tensor, " b"]
    certain: Bool[Tensor, "b h w"]
    """Where the warp shows a surface through space that was seen to be empty."""
    warp_log_depth: Float[Tensor, "b h w"]
    """Means nothing where the warp shows nothing."""

    def depth(self, log_depth: Float[Tensor, "b h w"]) -> Float[Tensor, "b h w"]:
        """Depth in scene units."""
        return log_depth.exp() * self.center_depth[:, None, None]


def observe(
    picture: Float[Tensor, "b 3 h w"],
    query: Camera,
    images: Float[Tensor, "b k 3 h2 w2"],
    depths: Float[Tensor, "b k h2 w2"],
    confidences: Float[Tensor, "b k h2 w2"],
    cameras: Camera,
    ball: Ball,
    measured: Float[Tensor, "b h w"],
    measured_confidence: Float[Tensor, "b h w"],
) -> Observation:
    """Describe each query by its picture, by what its references show and leave open, and by what
    a depth source measured.

    `query` is batched `b` and `cameras` `b k`; depth 0 is unknown.
    """
    valid = torch.ones(depths.shape[:2], dtype=torch.bool, device=depths.device)
    warp = warp_references(images, depths, cameras, valid, query)
    sure = confidences[:, :, None].expand(-1, -1, 3, -1, -1).contiguous()
    confidence = warp_references(sure, depths, cameras, valid, query).image[:, 0]
    surface = warp.depth * warp.mask
    seen = trace_visibility(depths, cameras, valid, query, surface, ball)

    center_depth = torch.einsum("bi,bi->b", query.world_to_cam[:, 2, :3], ball.center)
    center_depth = (center_depth + query.world_to_cam[:, 2, 3]).clamp(min=1e-6)
    scale = center_depth[:, None, None]
    unobserved = seen.unobserved / ball.radius[:, None, None]
    certain = (surface > 0) & (unobserved <= MAX_UNOBSERVED)
    warped = _log(surface / scale)
    prior = fill_holes(warped[:, None], certain.to(warped.dtype))[:, 0]
    enters = seen.entry.isfinite()
    entry = torch.where(enters, _log(torch.where(enters, seen.entry, scale) / scale), prior)
    leaves = _log(torch.where(enters, seen.entry + seen.unobserved, scale) / scale)
    height, width = picture.shape[-2:]
    v, u = torch.meshgrid(
        torch.linspace(-1, 1, height, device=picture.device),
        torch.linspace(-1, 1, width, device=picture.device),
        indexing="ij",
    )
    maps = [
        warp.mask,
        confidence,
        torch.where(surface > 0, warped, 0),
        unobserved.clamp(max=2),
        entry,
        enters.to(prior.dtype),
        torch.where(enters, leaves, 0),
        prior,
        certain.to(prior.dtype),
        torch.where(measured > 0, _log(measured / scale), prior),
        torch.where(measured > 0, measured_confidence, 0),
        u.expand_as(prior),
        v.expand_as(prior),
    ]
    colours = [2 * picture - 1, (2 * warp.image - 1) * warp.mask[:, None]]
    return Observation(
        torch.cat([*colours, torch.stack(maps, 1)], 1),
        center_depth,
        certain,
        warped,
    )


def _log(ratio: Tensor) -> Tensor:
    return ratio.clamp(min=_MIN_RATIO).log().clamp(max=FARTHEST)
