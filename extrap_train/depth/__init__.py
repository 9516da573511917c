"""Depth behind one protocol: pairwise point maps with confidence, as a pairwise 3D model gives them.

A source is added with one file here and one YAML under `conf/depth/`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from jaxtyping import Float
from torch import Tensor

from extrap_train.views import View


@dataclass(frozen=True)
class PointMaps:
    """A point per pixel for each of two views, both in the *first* camera's frame and in scene units."""

    first: Float[Tensor, "h w 3"]
    second: Float[Tensor, "h2 w2 3"]
    first_confidence: Float[Tensor, "h w"]
    second_confidence: Float[Tensor, "h2 w2"]
    """Not negative; 0 where the point means nothing. Ranks pixels, is no probability."""


@dataclass(frozen=True)
class DepthMap:
    """Depth of one view (0 = unknown) with its confidence (0 = unknown, higher is surer)."""

    depth: Float[Tensor, "h w"]
    confidence: Float[Tensor, "h w"]


class DepthSource(Protocol):
    """Geometry from posed views."""

    def point_maps(self, first: View, second: View) -> PointMaps:
        """Both views' point maps, from these two views alone."""
        ...

    def depth_map(self, view: View, neighbours: Sequence[View]) -> DepthMap:
        """One view's depth, with the help of others that see the same surface."""
        ...
