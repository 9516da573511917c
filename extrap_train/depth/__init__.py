"""Depth behind one protocol: pairwise point maps with confidence, as a pairwise 3D model has them.

`DatasetDepth` estimates nothing: it is the depth that comes with the data.

A source is added with one file (a class with the protocol `DepthSource`) and one YAML under
`conf/depth/` that names the class as `factory`.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.errors import InputError
from extrap_train.geometry.cameras import transform, unproject
from extrap_train.views import View, resample_surfaces

RELIABLE_CONFIDENCE = 0.3
"""Least confidence of a depth to be used: about half of what lies below is wrong, little above."""


class NoDepthError(InputError):
    """No view of a capture has any depth, for a reason that lies in how the views were chosen."""


@dataclass(frozen=True)
class PointMaps:
    """A point per pixel for each of two views, both in the *first* camera's frame; scene units."""

    first: Float[Tensor, "h w 3"]
    second: Float[Tensor, "h2 w2 3"]
    first_confidence: Float[Tensor, "h w"]
    second_confidence: Float[Tensor, "h2 w2"]
    """Not negative; 0 where the point means nothing. Ranks pixels, is not a probability."""


@dataclass(frozen=True)
class DepthMap:
    """Depth of one view (0 = unknown) with its confidence (0 = unknown, higher is more certain)."""

    depth: Float[Tensor, "h w"]
    confidence: Float[Tensor, "h w"]

    def reliable(self) -> Float[Tensor, "h w"]:
        """Depth, and 0 (unknown) where the confidence is below `RELIABLE_CONFIDENCE`."""
        return torch.where(self.confidence >= RELIABLE_CONFIDENCE, self.depth, 0)

    def resized(self, height: int, width: int) -> "DepthMap":
        """The map at another size: interpolated on a surface, by the nearest pixel at its edges."""
        if self.depth.shape == (height, width):
            return self
        both = torch.stack([self.depth, self.confidence])
        return DepthMap(*resample_surfaces(both, (height, width)))


def require_depth(view: View) -> Float[Tensor, "h w"]:
    """The view's depth; InputError where it has none."""
    if view.depth is None:
        raise InputError(
            f"{view.name or 'a view'}: has no depth; use depth=stereo, which estimates it from "
            "the photographs"
        )
    return view.depth


def point_maps_of(
    first: View, first_map: DepthMap, second: View, second_map: DepthMap
) -> PointMaps:
    """Unproject two depth maps to points in the first camera's frame."""
    second_to_first = first.camera.world_to_cam @ second.camera.cam_to_world
    points = unproject(second_map.depth, second.camera)
    return PointMaps(
        first=unproject(first_map.depth, first.camera),
        second=transform(second_to_first, points.flatten(0, 1)).view_as(points),
        first_confidence=first_map.confidence,
        second_confidence=second_map.confidence,
    )


@runtime_checkable
class DepthSource(Protocol):
    """Geometry from posed views."""

    @property
    def image_size(self) -> int | None:
        """Longer side that depth is estimated at, in pixels; None where it comes with the data."""
        ...

    def point_maps(self, first: View, second: View) -> PointMaps:
        """Both views' point maps, from these two views alone."""
        ...

    def depth_map(self, view: View, neighbours: Sequence[View]) -> DepthMap:
        """One view's depth, with the help of others that see the same surface."""
        ...

    def depth_maps(self, views: Sequence[View]) -> list[DepthMap]:
        """The depth of every view of one sequence; each finds its neighbours among the others.

        Views without any are named in one warning. InputError where none can have any.
        """
        ...


LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class DatasetDepth:
    """The depth that comes with the data: CO3D's, a capture's, or the exact depth of renderings.

    Confidence is 1 where depth is known, else 0.
    """

    @property
    def image_size(self) -> None:
        """None: depth comes at the size of the photographs."""

    def depth_map(self, view: View, neighbours: Sequence[View]) -> DepthMap:
        """The view's own depth; the neighbours are not looked at. InputError if it has none."""
        depth = require_depth(view)
        return DepthMap(depth, (depth > 0).to(depth.dtype))

    def depth_maps(self, views: Sequence[View]) -> list[DepthMap]:
        """Every view's own depth; 0, unknown, and a warning for single views without one.

        InputError if none has any.
        """
        without = [view for view in views if view.depth is None]
        if without and len(without) == len(views):
            require_depth(without[0])
        if without:
            LOG.warning(
                "depth=dataset: %d of %d views have no depth (%s is the first); use depth=stereo "
                "to estimate it from the photographs",
                len(without),
                len(views),
                without[0].name or "a view",
            )
        return [
            DepthMap(*torch.zeros_like(view.image[:2]))
            if view.depth is None
            else self.depth_map(view, ())
            for view in views
        ]

    def point_maps(self, first: View, second: View) -> PointMaps:
        """Both views' points in the first camera's frame."""
        one, two = self.depth_map(first, ()), self.depth_map(second, ())
        return point_maps_of(first, one, second, two)
