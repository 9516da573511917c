"""Depth of posed views from a pairwise point-map network."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from extrap_train.config import Mast3rConfig
from extrap_train.depth import DepthMap, PointMaps, point_maps_of
from extrap_train.depth.mast3r.known_cameras import posed_depths
from extrap_train.depth.mast3r.network.crop import Crop, crop_for, network_input
from extrap_train.depth.mast3r.network.point_map_network import Encoding, PointMapNetwork
from extrap_train.depth.neighbours import WIDEST_RAD, neighbours_of
from extrap_train.errors import InputError
from extrap_train.views import Camera, View, combine

SAME_DEPTH = math.log(1.05)
"""Estimates whose logarithms differ by more mean different surfaces."""


@dataclass(frozen=True)
class _Prepared:
    """A view as the network sees it, with the way back."""

    view: View
    crop: Crop
    camera: Camera
    """Camera of the picture that the network sees."""
    encoding: Encoding

    def undone(self, depth_map: DepthMap) -> DepthMap:
        """Depth of what the network sees as depth of the view, where the view's picture lies."""
        back = undo_crop(self.crop, depth_map, self.view.camera.height, self.view.camera.width)
        return combine([back], lambda tensors: tensors[0].to(self.view.image))


@dataclass(frozen=True)
class Mast3rDepth:
    """Each pair gives both its views a depth; known cameras stay as they are, and set the scale.

    Confidence is from 0 to 1: the network's own, less where pairs disagree.
    """

    config: Mast3rConfig
    network: PointMapNetwork = field(repr=False, compare=False)

    @property
    def image_size(self) -> int:
        """Longer side that depth is estimated at, in pixels."""
        return self.config.image_size

    def point_maps(self, first: View, second: View) -> PointMaps:
        """Both views' points in the first camera's frame, in scene units.

        InputError where the pair's scale cannot be found: no baseline, or nothing in common.
        """
        found = self._pair(self._prepare(first), self._prepare(second))
        if found is None:
            names = " and ".join(view.name or "a view" for view in (first, second))
            raise InputError(
                f"{names}: their cameras have no baseline, or they show too little in common for "
                "depth=mast3r; leave one of them out"
            )
        return point_maps_of(first, found[0], second, found[1])

    def depth_map(self, view: View, neighbours: Sequence[View]) -> DepthMap:
        """One view's depth from its pairs with the most useful neighbours.

        InputError if none of them makes a pair whose scale is known.
        """
        views = [view, *neighbours]
        pairs = {(0, other) for other in self._neighbours(views)[0]}
        found = self._fuse_pairs(views, pairs, wanted={0})
        if not found:
            raise InputError(
                f"{view.name or 'a view'}: no other view shows enough of the same from another "
                "place, which depth=mast3r needs; use depth=dataset or add photographs"
            )
        return found[0]

    def depth_maps(self, views: Sequence[View]) -> list[DepthMap]:
        """The depth of every view of a capture; 0, unknown, where no pair can be used."""
        pairs = {
            (min(i, j), max(i, j))
            for i, others in enumerate(self._neighbours(views))
            for j in others
        }
        found = self._fuse_pairs(views, pairs, wanted=set(range(len(views))))
        return [
            found[i] if i in found else DepthMap(*torch.zeros_like(view.image[:2]))
            for i, view in enumerate(views)
        ]

    def _neighbours(self, views: Sequence[View]) -> list[list[int]]:
        return neighbours_of(views, self.config.neighbours, WIDEST_RAD)

    def _fuse_pairs(
        self, views: Sequence[View], pairs: set[tuple[int, int]], wanted: set[int]
    ) -> dict[int, DepthMap]:
        """Each wanted view's depth from all that its pairs say, if they say any.

        A view is encoded once, and it is fused and forgotten as soon as its last pair is done: of
        a capture's many views only some neighbours' are in memory at a time.
        """
        last = {view: pair for pair in sorted(pairs) for view in pair}
        prepared: dict[int, _Prepared] = {}
        estimates: dict[int, list[DepthMap]] = {view: [] for view in last}
        depths: dict[int, DepthMap] = {}
        for pair in sorted(pairs):
            for view in pair:
                if view not in prepared:
                    prepared[view] = self._prepare(views[view])
            found = self._pair(*(prepared[view] for view in pair))
            for place, view in enumerate(pair):
                if found is not None and view in wanted:
                    estimates[view].append(found[place])
                if last[view] == pair:
                    said = estimates.pop(view)
                    del prepared[view]
                    if said:
                        depths[view] = fuse_depth_maps(said)
        return depths

    @torch.no_grad()
    def _prepare(self, view: View) -> _Prepared:
        patch, device = self.network.architecture.patch, self.network.mask_token.device
        crop = crop_for(view, self.config.image_size, patch, self.config.square)
        small = crop.apply(view)
        encoding = self.network.encode(network_input(small, device))
        return _Prepared(view, crop, small.camera, encoding)

    @torch.no_grad()
    def _pair(self, first: _Prepared, second: _Prepared) -> tuple[DepthMap, DepthMap] | None:
        predictions = self.network.decode(first.encoding, second.encoding)
        found = posed_depths(*predictions, first.camera, second.camera)
        return found and (first.undone(found[0]), second.undone(found[1]))


def fuse_depth_maps(estimates: Sequence[DepthMap]) -> DepthMap:
    """The confidence-weighted median of each pixel, then the mean of the estimates that agree.

    Confidence is the mean of those that agree times their share of the weight. Unknown where all
    are. One estimate stays as it is.
    """
    depths = torch.stack([estimate.depth for estimate in estimates])
    weights = torch.stack([estimate.confidence for estimate in estimates]) * (depths > 0)
    logs = depths.clamp_min(1e-30).log()
    agree = weights * ((logs - weighted_median(logs, weights)).abs() <= SAME_DEPTH)
    total, known = weights.sum(0), agree.sum(0)
    safe = known.clamp_min(1e-12)
    mean = ((logs * agree).sum(0) / safe).exp()
    confidence = agree.square().sum(0) / safe * known / total.clamp_min(1e-12)
    return DepthMap(torch.where(known > 0, mean, 0), torch.where(known > 0, confidence, 0))


def weighted_median(
    values: Float[Tensor, "k ..."], weights: Float[Tensor, "k ..."]
) -> Float[Tensor, "*n"]:
    """The least value that, with all below it, has half the weight; anything where that is 0."""
    order = values.argsort(0)
    heights = weights.gather(0, order).cumsum(0)
    middle = (heights < heights[-1:] / 2).sum(0, keepdim=True).clamp_max(len(values) - 1)
    return values.gather(0, order).gather(0, middle)[0]


def undo_crop(crop: Crop, depth_map: DepthMap, height: int, width: int) -> DepthMap:
    """Depth of a crop as depth of the view that it came from; unknown (0) outside."""
    below = crop.resized[0] - crop.top - crop.height
    right = crop.resized[1] - crop.left - crop.width
    margins = (crop.left, right, crop.top, below)
    whole = DepthMap(
        functional.pad(depth_map.depth, margins), functional.pad(depth_map.confidence, margins)
    )
    return whole.resized(height, width)
