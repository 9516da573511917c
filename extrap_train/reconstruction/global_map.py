"""What is known of a scene: posed views with depth, confidence and origin, and no point twice; what
one of them says of points, and all of them to a camera.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from extrap_train.geometry.cameras import project, unproject_to_world
from extrap_train.geometry.viewpoints import references_by_nearness
from extrap_train.geometry.warp import warp_references
from extrap_train.geometry.warp.surface import surface_from_depth
from extrap_train.views import Camera, View, stack_cameras


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
    """Index of the pixel that the point falls into; 0 outside the picture."""
    inside: Bool[Tensor, " n"]
    """Whether the point falls into the picture, with a known depth there or not."""
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
    return Lookup(torch.where(known, sight, Sight.UNSEEN), index, inside, z)


def _range_around(
    depth: Float[Tensor, "h w"],
) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
    """Least and greatest known depth in each 3 × 3 window."""
    known = depth > 0
    low = torch.where(known, depth, torch.inf)[None, None]
    nearest = -functional.max_pool2d(-low, 3, 1, 1)[0, 0]
    farthest = functional.max_pool2d(depth[None, None], 3, 1, 1)[0, 0]
    return nearest, farthest


GIVEN, GENERATED = "given", "generated"
MAX_COMPARED = 8
"""Views, the nearest ones, that a new one is compared with: the cost of a step stays the same."""


@dataclass(frozen=True)
class Origin:
    """Where a view comes from."""

    kind: str
    """`given` or `generated`."""
    root: int
    """Index of the given view at the root of its chain of nearest references."""
    references: tuple[int, ...] = ()
    """Indices of the views that it was made from, nearest first."""
    seed: int = 0
    agreement: float = 1.0
    """Share of its testable pixels that agreed with the map when it came."""


@dataclass(frozen=True)
class MapView:
    """One view of the map, all at one image size."""

    view: View
    confidence: Float[Tensor, "h w"]
    """0 to 1, and 0 where depth is unknown."""
    fresh: Bool[Tensor, "h w"]
    """Pixels on a surface that no earlier view shows: the points that the view adds."""
    origin: Origin

    @property
    def depth(self) -> Float[Tensor, "h w"]:
        """The view's depth; 0 is unknown."""
        assert self.view.depth is not None
        return self.view.depth

    @property
    def camera(self) -> Camera:
        """The view's camera."""
        return self.view.camera


@dataclass(frozen=True)
class GlobalMap:
    """Views in the order in which they came; adding one leaves the others untouched."""

    tolerance: float
    """Relative difference of depth up to which two views show the same surface."""
    views: tuple[MapView, ...] = ()

    def __len__(self) -> int:
        return len(self.views)

    @property
    def given(self) -> tuple[MapView, ...]:
        """The views that were not generated: the first ones."""
        return tuple(view for view in self.views if view.origin.kind == GIVEN)

    @property
    def cameras(self) -> Camera:
        """All cameras, batched."""
        return stack_cameras([view.camera for view in self.views])

    def nearest(self, camera: Camera, count: int, *, photographs: bool = False) -> list[int]:
        """Indices of the views nearest to an (unbatched) camera, nearest first: of all views, or of
        the `photographs` alone.
        """
        if not self.views:
            return []
        order = references_by_nearness(self.cameras, stack_cameras([camera]))[0].tolist()
        chosen = [i for i in order if not photographs or self.views[i].origin.kind == GIVEN]
        return chosen[:count]

    def added(
        self, view: View, confidence: Float[Tensor, "h w"], origin: Origin
    ) -> tuple["GlobalMap", MapView]:
        """The map with one more view, which must have a depth; and that view."""
        assert view.depth is not None
        known = view.depth > 0
        points = unproject_to_world(view.depth, view.camera).flatten(0, 1)
        shown = torch.zeros(len(points), dtype=torch.bool)
        for index in self.nearest(view.camera, MAX_COMPARED):
            shown |= _shown_by(self.views[index], points, self.tolerance)
        fresh = surface_from_depth(view.depth, view.camera).valid & ~shown.view_as(known)
        added = MapView(view, torch.where(known, confidence, 0), fresh, origin)
        return replace(self, views=(*self.views, added)), added


def _shown_by(view: MapView, points: Float[Tensor, "n 3"], tolerance: float) -> Bool[Tensor, " n"]:
    """Which points lie on the surface that the view has in the very pixel they fall into.

    A steep surface changes its depth within a pixel; that much more is allowed.
    """
    found = look_up(points, view.depth, view.camera, tolerance)
    surface = surface_from_depth(view.depth, view.camera)
    left, right, up, low = surface.slopes.abs().unbind(-3)
    within = (torch.maximum(left, right) + torch.maximum(up, low)) / 2
    within = (within / surface.inverse_depth.clamp(min=1e-30)).flatten()[found.pixel]
    inverse = surface.inverse_depth.flatten()[found.pixel]
    same = (found.depth * inverse - 1).abs() <= tolerance + within
    seen = found.sight != Sight.UNSEEN
    return seen & surface.valid.flatten()[found.pixel] & same


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


def prior_of(scene_map: GlobalMap, camera: Camera, indices: Sequence[int]) -> Prior:
    """The map's picture, depth and confidence for a camera, from some of its views."""
    views = [scene_map.views[index] for index in indices]
    cameras = stack_cameras([stack_cameras([view.camera for view in views])])
    depths = torch.stack([view.depth for view in views])[None]
    valid = torch.ones(1, len(views), dtype=torch.bool)
    query = stack_cameras([camera])
    images = torch.stack([view.view.image for view in views])[None]
    warp = warp_references(images, depths, cameras, valid, query)
    confidence = torch.stack([view.confidence.expand(3, -1, -1) for view in views])[None]
    carried = warp_references(confidence.contiguous(), depths, cameras, valid, query)
    return Prior(warp.image[0], warp.depth[0] * warp.mask[0], carried.image[0, 0])
