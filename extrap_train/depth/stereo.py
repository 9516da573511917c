"""Depth by plane-sweep multi-view stereo (Collins, 1996) from photographs with known cameras."""

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from extrap_train.config import StereoConfig
from extrap_train.depth import DepthMap, NoDepthError, PointMaps, point_maps_of
from extrap_train.depth.neighbours import (
    LIMIT_RAD,
    MIN_RAD,
    convergence_point,
    inverse_depth_range,
    nearest_angle_rad,
    neighbours_of,
)
from extrap_train.depth.photo_cost import projection_between
from extrap_train.depth.plane_sweep import Estimate, sweep
from extrap_train.geometry.cameras import pixel_grid
from extrap_train.views import Camera, View

LOG = logging.getLogger(__name__)
NAMED = 4
"""Most views that a message names."""


@dataclass(frozen=True)
class PlaneSweepStereo:
    """Depth wherever two views see the same textured surface.

    Confidence is the correlation of the windows (0 to 1) times how well the neighbours' depths
    agree; it is 0 where they contradict the estimate, no neighbour sees the pixel, or there is no
    texture. Depth is kept there too: `DepthMap.reliable` says what to use. Nothing in the scene
    may move between the photographs.
    """

    config: StereoConfig

    @property
    def image_size(self) -> int:
        """Longer side that depth is estimated at, in pixels."""
        return self.config.image_size

    def depth_map(self, view: View, neighbours: Sequence[View]) -> DepthMap:
        """One view's depth; the neighbours' are computed too, for the consistency check.

        NoDepthError if no neighbour sees the scene from a useful angle.
        """
        views = [view, *neighbours]
        helpers = self.neighbours(views)
        _require_helpers(view, neighbours, helpers[0])
        for other in range(1, len(views)):
            rest = [i for i in helpers[other] if i != 0]
            helpers[other] = [0, *rest][: self.config.neighbours]
        return self._maps(views, helpers, wanted=[0])[0]

    def depth_maps(self, views: Sequence[View]) -> list[DepthMap]:
        """Depth of every view of a capture; each is matched once and checked against others.

        A view that no other one helps gets depth 0, unknown, everywhere; one warning names these,
        another those that are sure nowhere. NoDepthError where that is every view.
        """
        helpers = self.neighbours(views)
        alone = [view for view, others in zip(views, helpers, strict=True) if not others]
        if alone and len(alone) == len(views):
            raise NoDepthError(_without_neighbours(alone, views))
        if alone:
            LOG.warning("%s", _without_neighbours(alone, views))
        maps = self._maps(list(views), helpers, wanted=range(len(views)))
        unsure = [
            view
            for view, others, found in zip(views, helpers, maps, strict=True)
            if others and not found.reliable().any()
        ]
        if unsure:
            LOG.warning(
                "depth=stereo finds no reliable depth for %d of %d views (%s): they show too "
                "little texture, or other surfaces than their neighbours, or their poses are wrong",
                len(unsure),
                len(views),
                _names(unsure),
            )
        return maps

    def point_maps(self, first: View, second: View) -> PointMaps:
        """Both views' points in the first camera's frame.

        NoDepthError if the two do not see the scene from usefully different angles.
        """
        helpers = self.neighbours([first, second])
        _require_helpers(first, [second], helpers[0])
        one, two = self._maps([first, second], helpers, wanted=(0, 1))
        return point_maps_of(first, one, second, two)

    def neighbours(self, views: Sequence[View]) -> list[list[int]]:
        """Indices of the views that help each view, the most useful first."""
        return neighbours_of(views, self.config.neighbours)

    def _maps(
        self, views: list[View], helpers: list[list[int]], wanted: Sequence[int]
    ) -> list[DepthMap]:
        working = [self._working(view) for view in views]
        center = convergence_point([view.camera for view in views])
        needed = sorted({*wanted, *(j for i in wanted for j in helpers[i])})
        estimates = {
            i: self._estimate(working[i], [working[j] for j in helpers[i]], center)
            for i in needed
            if helpers[i]
        }
        maps = []
        for i in wanted:
            height, width = views[i].camera.height, views[i].camera.width
            if helpers[i]:
                checked = _check(i, helpers[i], working, estimates)
                maps.append(checked.resized(height, width))
            else:
                maps.append(DepthMap(*views[i].image.new_zeros(2, height, width)))
        return maps

    def _working(self, view: View) -> View:
        """The view at the resolution of matching."""
        view = replace(view, depth=None, mask=None)
        scale = self.config.image_size / max(view.camera.height, view.camera.width)
        if scale >= 1:
            return view
        return view.resized(
            max(1, round(view.camera.height * scale)), max(1, round(view.camera.width * scale))
        )

    def _estimate(
        self, view: View, neighbours: list[View], center: Float[Tensor, "3"] | None
    ) -> Estimate:
        bounds = inverse_depth_range(view.camera, [n.camera for n in neighbours], center)
        return sweep(view, neighbours, bounds, self.config.planes)


def _require_helpers(view: View, others: Sequence[View], helpers: list[int]) -> None:
    if not helpers:
        raise NoDepthError(_without_neighbours([view], [view, *others]))


def _without_neighbours(alone: Sequence[View], views: Sequence[View]) -> str:
    """One line: which views have no neighbour and so no depth, why, and what helps."""
    least, most = (round(math.degrees(limit)) for limit in (MIN_RAD, LIMIT_RAD))
    nearest = nearest_angle_rad(views)
    if nearest is not None and nearest > LIMIT_RAD:
        why = f"; the nearest two views are {math.degrees(nearest):.0f}° apart"
    elif len(views) > 1 and len(alone) == len(views):
        why = "; the views stand in one place, or their poses are wrong"
    else:
        why = ""
    return (
        f"depth=stereo finds no depth for {len(alone)} of {len(views)} views ({_names(alone)}): no "
        f"other view sees the scene from {least}° to {most}° beside them{why}; give more or "
        "nearer photographs (inputs=, input_frames=), the depth of a capture that has it "
        "(depth=dataset), or a learned source (depth=mast3r, depth=monocular)"
    )


def _names(views: Sequence[View]) -> str:
    first = ", ".join(view.name or "a view" for view in views[:NAMED])
    return first + (", …" if len(views) > NAMED else "")


def _check(
    index: int, helpers: list[int], views: list[View], estimates: dict[int, Estimate]
) -> DepthMap:
    own = estimates[index]
    errors = [
        forward_backward_error(
            own.inverse_depth,
            views[index].camera,
            estimates[other].inverse_depth,
            views[other].camera,
        )
        for other in helpers
    ]
    return DepthMap(1 / own.inverse_depth, own.correlation * agreement(torch.stack(errors)))


MAX_ERROR = 2.0
"""Forward-backward error, in pixels, from which two depths contradict each other."""


def forward_backward_error(
    inverse_depth: Float[Tensor, "h w"],
    camera: Camera,
    other_inverse_depth: Float[Tensor, "h2 w2"],
    other_camera: Camera,
) -> Float[Tensor, "h w"]:
    """How many pixels from where it started a pixel returns: there by its own depth, back by the
    other view's. Infinite where the other view does not see the point."""
    there = projection_between(camera, other_camera)
    coordinates, inside = there.normalised_points(inverse_depth)
    found = functional.grid_sample(
        other_inverse_depth[None, None],
        coordinates[None],
        padding_mode="border",
        align_corners=False,
    )[0, 0]
    pixels, _ = there.points(inverse_depth)
    returned = projection_between(other_camera, camera, pixels).points(found)[0]
    grid = pixel_grid(camera.height, camera.width, inverse_depth.device)
    return torch.where(inside, (returned - grid).norm(dim=-1), torch.inf)


def agreement(errors: Float[Tensor, "k h w"]) -> Float[Tensor, "h w"]:
    """Mean of exp(−error²/2) over the better half of the neighbours: 1 is perfect, 0 contradiction.

    Only half of them have to agree: a point may be hidden from the others.
    """
    each = torch.where(errors < MAX_ERROR, (-errors.square() / 2).exp(), 0)
    return each.sort(0, descending=True).values[: (len(each) + 1) // 2].mean(0)
