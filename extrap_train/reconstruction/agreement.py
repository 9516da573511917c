"""What one view says of points: confirmed, hidden behind its surface, or seen through."""

from dataclasses import dataclass
from enum import IntEnum

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from extrap_train.geometry.cameras import project
from extrap_train.views import Camera


class Sight(IntEnum):
    """How a point lies to a view's surface."""

    UNSEEN = 0
    """Outside the picture, or where its depth is unknown."""
    AGREES = 1
    """On the surface."""
    HIDDEN = 2
    """Behind it."""
    IN_FRONT = 3
    """In front of it: the view has looked through the point."""


@dataclass(frozen=True)
class Lookup:
    """What one view says of each point."""

    sight: Int[Tensor, " n"]
    """A `Sight`."""
    pixel: Int[Tensor, " n"]
    """Index of the pixel that the point falls into; 0 where unseen."""
    depth: Float[Tensor, " n"]
    """The point's own, in the view's camera."""


def look_up(
    points: Float[Tensor, "n 3"], depth: Float[Tensor, "h w"], camera: Camera, tolerance: float
) -> Lookup:
    """Each point's `Sight` for one view; `tolerance` is a relative difference of depth.

    At an occlusion edge either surface within a pixel will do, and a point is in front only if it
    is in front of both: edges are never certain to the pixel.
    """
    pixels, z = project(points, camera)
    column, row = pixels.floor().long().unbind(-1)
    inside = (z > 0) & (column >= 0) & (column < camera.width)
    inside &= (row >= 0) & (row < camera.height)
    index = torch.where(inside, row * camera.width + column, 0)
    nearest, farthest = _range_around(depth)
    own, near, far = (x.flatten()[index] for x in (depth, nearest, farthest))
    known = inside & (own > 0)
    agrees = torch.stack([(z / d.clamp(min=1e-30) - 1).abs() for d in (own, near, far)]).amin(0)
    sight = torch.where(z < near * (1 - tolerance), Sight.IN_FRONT, Sight.HIDDEN)
    sight = torch.where(agrees <= tolerance, Sight.AGREES, sight)
    return Lookup(torch.where(known, sight, Sight.UNSEEN), index, z)


def _range_around(
    depth: Float[Tensor, "h w"],
) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
    """Least and greatest known depth in each 3 × 3 window."""
    known = depth > 0
    low = torch.where(known, depth, torch.inf)[None, None]
    nearest = -functional.max_pool2d(-low, 3, 1, 1)[0, 0]
    farthest = functional.max_pool2d(depth[None, None], 3, 1, 1)[0, 0]
    return nearest, farthest
