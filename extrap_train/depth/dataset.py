"""The depth that comes with the data: CO3D's, a capture's, or the exact depth of renderings."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from extrap_train.depth import DepthMap, PointMaps, point_maps_of, require_depth
from extrap_train.views import View

LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class DatasetDepth:
    """Confidence is 1 where depth is known, else 0."""

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
