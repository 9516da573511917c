"""The depth of a generated view from the network, fitted to what the map knows."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from extrap_train.depth import DepthSource
from extrap_train.geometry.visibility import Ball
from extrap_train.reconstruction.continuation import extend_harmonically, neighbour_ties
from extrap_train.reconstruction.depth_prediction.network import DepthNetwork
from extrap_train.reconstruction.depth_prediction.observation import Observation, observe
from extrap_train.reconstruction.global_map import GlobalMap
from extrap_train.reconstruction.measurement import measure
from extrap_train.views import View, resample_surfaces, stack_cameras

WORKING_SIZE = 128
"""Side of the pictures that the network is trained on."""
EDGE = 0.03
"""Difference of log depth between neighbours that are two surfaces."""
LEAK = 1e-3
"""How fast the correction at the rim fades: over about 1/sqrt(LEAK) pixels."""
MAX_CORRECTION = 0.1
"""Difference of log depth at the rim above which the network shows another surface."""


@dataclass(frozen=True)
class PredictedDepth:
    """A view's dense depth before it enters the map."""

    depth: Float[Tensor, "h w"]
    confidence: Float[Tensor, "h w"]
    """Probability that the depth is right to within 2 %."""
    certain: Bool[Tensor, "h w"]
    """Where the map shows a surface through space that was seen to be empty."""

    def resized(self, height: int, width: int) -> "PredictedDepth":
        """The same for a picture of another size."""
        if self.depth.shape == (height, width):
            return self
        maps = torch.stack([self.depth, self.confidence, self.certain.to(self.depth.dtype)])
        depth, confidence, certain = resample_surfaces(maps, (height, width))
        return PredictedDepth(depth, confidence.clamp(0, 1), certain > 0.5)


class DepthPredictor(Protocol):
    """Predicts the depth of a generated view; the network does, and a test's oracle."""

    def __call__(
        self, scene_map: GlobalMap, picture: View, indices: Sequence[int]
    ) -> PredictedDepth:
        """The depth of a picture, of which the map's views `indices` show parts."""
        ...


@dataclass(frozen=True)
class NetworkDepth:
    """The network's answer, corrected so that it meets the map where that is certain."""

    network: DepthNetwork
    source: DepthSource
    """Measures what the network starts from."""

    @torch.inference_mode()
    def __call__(
        self, scene_map: GlobalMap, picture: View, indices: Sequence[int]
    ) -> PredictedDepth:
        """See `DepthPredictor`."""
        seen = observe_in_map(scene_map, picture, indices, self.source)
        log_depth, confidence = self.network(seen.features).best()
        fitted = fit_to_known(log_depth[0], seen.warp_log_depth[0], seen.certain[0])
        completed = PredictedDepth(
            seen.depth(fitted[None])[0], confidence[0].clamp(0, 1), seen.certain[0]
        )
        return completed.resized(picture.camera.height, picture.camera.width)


def observe_in_map(
    scene_map: GlobalMap, picture: View, indices: Sequence[int], source: DepthSource
) -> Observation:
    """Describe a picture at the network's size by what the map's views `indices` show of it."""
    views = [scene_map.views[index] for index in indices]
    size = (WORKING_SIZE, WORKING_SIZE)
    found = measure(scene_map, picture, indices, source)
    measured = torch.stack([found.depth, found.confidence]) * found.reliable
    if measured.shape[-2:] != size:
        measured = resample_surfaces(measured, size)
    return observe(
        functional.interpolate(picture.image[None], size, mode="area"),
        stack_cameras([picture.camera.resized(*size)]),
        torch.stack([view.view.image for view in views])[None],
        torch.stack([view.depth for view in views])[None],
        torch.stack([view.confidence for view in views])[None],
        stack_cameras([stack_cameras([view.camera for view in views])]),
        Ball.around(scene_map.cameras),
        measured[:1],
        measured[1:],
    )


def fit_to_known(
    log_depth: Float[Tensor, "h w"],
    known_log_depth: Float[Tensor, "h w"],
    certain: Bool[Tensor, "h w"],
) -> Float[Tensor, "h w"]:
    """What is certain, and beyond it the network's depth moved by what it is off by at the rim.

    The correction is carried along the network's own surfaces and fades with the distance.
    """
    off = torch.where(certain, known_log_depth - log_depth, 0)
    fits = certain & (off.abs() < MAX_CORRECTION)
    if not fits.any() or fits.all():
        return torch.where(certain, known_log_depth, log_depth)
    ties = neighbour_ties(log_depth.double().numpy()[..., None] / EDGE)
    extended = extend_harmonically(
        off.double().numpy().ravel(), fits.numpy().ravel(), ties, LEAK
    ).reshape(off.shape)
    moved = log_depth + torch.from_numpy(np.ascontiguousarray(extended)).to(log_depth.dtype)
    return torch.where(certain, known_log_depth, moved)
