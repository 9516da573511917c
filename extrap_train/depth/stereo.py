"""Depth by plane-sweep multi-view stereo (Collins, 1996) from photographs with known cameras."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.config import StereoConfig
from extrap_train.depth import DepthMap, PointMaps, point_maps_of
from extrap_train.depth.consistency import agreement, forward_backward_error
from extrap_train.depth.depth_range import convergence_point, inverse_depth_range
from extrap_train.depth.neighbours import neighbours_of
from extrap_train.depth.plane_sweep import Estimate, sweep
from extrap_train.depth.resample import resampled
from extrap_train.errors import InputError
from extrap_train.views import View


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

        InputError if no neighbour sees the scene from a useful angle.
        """
        views = [view, *neighbours]
        helpers = self.neighbours(views)
        _require_helpers(view, helpers[0])
        for other in range(1, len(views)):
            rest = [i for i in helpers[other] if i != 0]
            helpers[other] = [0, *rest][: self.config.neighbours]
        return self._maps(views, helpers, wanted=[0])[0]

    def depth_maps(self, views: Sequence[View]) -> list[DepthMap]:
        """Depth of every view of a capture; each is matched once and checked against others.

        A view that no other one helps gets depth 0, unknown, everywhere.
        """
        return self._maps(list(views), self.neighbours(list(views)), wanted=range(len(views)))

    def point_maps(self, first: View, second: View) -> PointMaps:
        """Both views' points in the first camera's frame.

        InputError if the two do not see the scene from usefully different angles.
        """
        helpers = self.neighbours([first, second])
        _require_helpers(first, helpers[0])
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
                maps.append(resampled(_checked(i, helpers[i], working, estimates), height, width))
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


def _require_helpers(view: View, helpers: list[int]) -> None:
    if not helpers:
        raise InputError(
            f"{view.name or 'a view'}: no other view sees the scene from 3° to 45° beside it, "
            "which depth=stereo needs; use depth=dataset or add photographs"
        )


def _checked(
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
    return DepthMap(1 / own.inverse_depth, own.likeness * agreement(torch.stack(errors)))
