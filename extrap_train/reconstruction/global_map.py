"""What is known of a scene: posed views with depth, confidence and origin, and no point twice."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from extrap_train.geometry.cameras import unproject_to_world
from extrap_train.geometry.viewpoints import references_by_nearness
from extrap_train.geometry.warp.surface import surface_from_depth
from extrap_train.reconstruction.agreement import Sight, look_up
from extrap_train.views import Camera, View, stack_cameras

GIVEN, GENERATED = "given", "generated"
MOST_COMPARED = 8
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
        for index in self.nearest(view.camera, MOST_COMPARED):
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
