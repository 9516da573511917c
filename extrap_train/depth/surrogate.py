"""A labelled stand-in for a monocular depth network, where none is at hand."""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from extrap_train.depth import DepthMap, DepthSource, PointMaps
from extrap_train.errors import InputError
from extrap_train.views import View


@dataclass(frozen=True)
class AffineSurrogate:
    """Another source's depth under an affine map that is unknown and differs a photograph.

    That is all that a monocular network can know at best, so a method that is given this is given
    no more than a perfect network's answer: numbers made with it are marked as a surrogate's.
    """

    source: DepthSource
    seed: int = 0

    @property
    def image_size(self) -> int | None:
        """That of the source."""
        return self.source.image_size

    def depth_map(self, view: View, neighbours: Sequence[View]) -> DepthMap:
        """The source's depth `z` as `scale · z / median + shift`, 0 where it is unknown."""
        return self._apply_affine(view, self.source.depth_map(view, neighbours))

    def depth_maps(self, views: Sequence[View]) -> list[DepthMap]:
        """Every view's depth under its own map."""
        pairs = zip(views, self.source.depth_maps(views), strict=True)
        return [self._apply_affine(view, found) for view, found in pairs]

    def point_maps(self, first: View, second: View) -> PointMaps:
        """InputError: two affine depths have no frame in common."""
        raise InputError("monocular depth has no scale that two views share; use another depth=")

    def _apply_affine(self, view: View, found: DepthMap) -> DepthMap:
        photograph = np.ascontiguousarray(view.image.numpy(force=True))
        rng = np.random.default_rng([self.seed, zlib.crc32(photograph.tobytes())])
        scale, shift = float(rng.uniform(0.5, 2)), float(rng.uniform(0, 1))
        known = found.depth > 0
        if not known.any():
            return found
        mapped = scale * found.depth / found.depth[known].median() + shift
        return replace(found, depth=mapped * known)
