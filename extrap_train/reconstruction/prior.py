"""What the map shows to a camera before there is a picture."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from extrap_train.geometry.warp import warp_references
from extrap_train.reconstruction.global_map import GlobalMap
from extrap_train.views import Camera, stack_cameras


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


def prior_of(known: GlobalMap, camera: Camera, indices: Sequence[int]) -> Prior:
    """The map's picture, depth and confidence for a camera, from some of its views."""
    views = [known.views[index] for index in indices]
    cameras = stack_cameras([stack_cameras([view.camera for view in views])])
    depths = torch.stack([view.depth for view in views])[None]
    valid = torch.ones(1, len(views), dtype=torch.bool)
    query = stack_cameras([camera])
    images = torch.stack([view.view.image for view in views])[None]
    warp = warp_references(images, depths, cameras, valid, query)
    confidence = torch.stack([view.confidence.expand(3, -1, -1) for view in views])[None]
    carried = warp_references(confidence.contiguous(), depths, cameras, valid, query)
    return Prior(warp.image[0], warp.depth[0] * warp.mask[0], carried.image[0, 0])
