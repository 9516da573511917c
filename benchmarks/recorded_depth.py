"""The inputs' depth, found once for all methods and charged to each that asks."""

from collections.abc import Sequence

from extrap_train.depth import DepthMap, PointMaps
from extrap_train.depth.dataset import DatasetDepth
from extrap_train.views import View


class RecordedDepth:
    """Depth that the views carry, as the protocol's source found it from the inputs alone.

    `seconds` is 0 until the first question and then what the source took.
    """

    def __init__(self, took_seconds: float) -> None:
        self._took = took_seconds
        self._carried = DatasetDepth()
        self.seconds = 0.0

    @property
    def image_size(self) -> None:
        """None: depth comes at the size of the inputs."""

    def depth_map(self, view: View, neighbours: Sequence[View]) -> DepthMap:
        """An input's depth; InputError for a view that is none of the inputs."""
        self.seconds = self._took
        return self._carried.depth_map(view, neighbours)

    def depth_maps(self, views: Sequence[View]) -> list[DepthMap]:
        """The depth of each of some inputs."""
        return [self.depth_map(view, ()) for view in views]

    def point_maps(self, first: View, second: View) -> PointMaps:
        """Two inputs' points in the first camera's frame."""
        self.seconds = self._took
        return self._carried.point_maps(first, second)
