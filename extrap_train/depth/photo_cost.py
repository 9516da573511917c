"""Matching cost of plane-sweep stereo: NCC of two views at hypothetical depths."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from extrap_train.depth.plane_sweep_numba import correlation_cost_numba, mean_of_better_numba
from extrap_train.geometry.cameras import pixel_grid
from extrap_train.geometry.ncc import COLOUR_NOISE, box_mean
from extrap_train.geometry.warp import needs_torch
from extrap_train.views import Camera, View

WINDOW = 5
"""Side of the window that is compared, in pixels."""
CHUNK_ELEMENTS = 4_000_000
"""Most colour samples that torch holds at a time."""
CHUNK_COSTS = 64_000_000
"""Most costs that the compiled kernel holds at a time."""


@dataclass(frozen=True)
class Projection:
    """Pixels of one view to pixels of another, as a function of inverse depth.

    A pixel p of inverse depth w lands at the homogeneous point A·p + w·e; e is the epipole.
    """

    at_infinity: Float[Tensor, "h w 3"]
    epipole: Float[Tensor, "3"]
    height: int
    width: int

    def points(
        self, inverse_depth: Float[Tensor, "*d h w"]
    ) -> tuple[Float[Tensor, "*d h w 2"], Float[Tensor, "*d h w"]]:
        """Pixels (u, v), and depth in the target as a multiple of depth in the source."""
        homogeneous = self.at_infinity + inverse_depth[..., None] * self.epipole
        scale = homogeneous[..., 2]
        return homogeneous[..., :2] / scale.clamp_min(1e-6)[..., None], scale

    def normalised_points(
        self, inverse_depth: Float[Tensor, "*d h w"]
    ) -> tuple[Float[Tensor, "*d h w 2"], Bool[Tensor, "*d h w"]]:
        """Normalised coordinates in the target, and whether they lie inside it, in front of it."""
        pixels, scale = self.points(inverse_depth)
        size = pixels.new_tensor([self.width, self.height])
        inside = ((pixels >= 0) & (pixels <= size)).all(-1) & (scale > 1e-6)
        return pixels / size * 2 - 1, inside


def projection_between(
    source: Camera, target: Camera, pixels: Float[Tensor, "h w 2"] | None = None
) -> Projection:
    """From `pixels` of `source`, by default its pixel centres, to pixels of `target`."""
    source_to_target = target.world_to_cam @ source.cam_to_world
    homography = target.intrinsics @ source_to_target[:3, :3] @ torch.linalg.inv(source.intrinsics)
    if pixels is None:
        pixels = pixel_grid(source.height, source.width, homography.device)
    homogeneous = functional.pad(pixels, (0, 1), value=1.0)
    epipole = target.intrinsics @ source_to_target[:3, 3]
    return Projection(homogeneous @ homography.mT, epipole, target.height, target.width)


class PhotoCost:
    """Cost of depth hypotheses of one view against its neighbours.

    1 − zero-mean normalised cross-correlation of colour windows (which exposure does not change),
    halved to [0, 1], and averaged over the better half of the neighbours: those that do not see
    the point disagree.
    """

    def __init__(self, view: View, neighbours: list[View]) -> None:
        self.image = view.image
        self.neighbours = [
            (projection_between(view.camera, other.camera), other.image) for other in neighbours
        ]
        self.mean = box_mean(self.image[None], WINDOW)
        self.variance = _variance(self.image[None], self.mean)

    def __call__(self, inverse_depth: Float[Tensor, "d h w"]) -> Float[Tensor, "d h w"]:
        """Cost in [0, 1] per hypothesis; 0.5, which says nothing, where no neighbour sees it."""
        in_torch = needs_torch(inverse_depth, self.image)
        cost = self.cost_torch if in_torch else self._cost_numba
        most = CHUNK_ELEMENTS // len(self.image) if in_torch else CHUNK_COSTS
        size = max(1, most // (self.image[0].numel() * len(self.neighbours)))
        return torch.cat([cost(chunk) for chunk in inverse_depth.split(size)])

    def _cost_numba(self, inverse_depth: Float[Tensor, "d h w"]) -> Float[Tensor, "d h w"]:
        costs = inverse_depth.new_empty(len(self.neighbours), *inverse_depth.shape)
        view = [x.movedim(0, -1).contiguous().numpy() for x in (self.image, self.mean[0])]
        for (projection, image), cost in zip(self.neighbours, costs, strict=True):
            correlation_cost_numba(
                inverse_depth.contiguous().numpy(),
                projection.at_infinity.contiguous().numpy(),
                projection.epipole.contiguous().numpy(),
                image.movedim(0, -1).contiguous().numpy(),
                *view,
                self.variance[0].contiguous().numpy(),
                (WINDOW // 2, np.float32(COLOUR_NOISE * len(image))),
                cost.numpy(),
            )
        mean = torch.empty_like(costs[0])
        mean_of_better_numba(costs.numpy(), mean.numpy())
        return mean

    def cost_torch(self, inverse_depth: Float[Tensor, "d h w"]) -> Float[Tensor, "d h w"]:
        """The cost in torch, for GPUs: the definition, without chunks."""
        costs = torch.stack(
            [
                self._against(projection, image, inverse_depth)
                for projection, image in self.neighbours
            ]
        )
        better = costs.sort(0).values[: (len(costs) + 1) // 2]
        seen = better.isfinite()
        total = torch.where(seen, better, 0).sum(0)
        return torch.where(seen.any(0), total / seen.sum(0).clamp_min(1), 0.5)

    def _against(
        self, projection: Projection, image: Float[Tensor, "c h2 w2"], inverse_depth: Tensor
    ) -> Float[Tensor, "d h w"]:
        coordinates, inside = projection.normalised_points(inverse_depth)
        warped = functional.grid_sample(
            image[None].expand(len(coordinates), -1, -1, -1),
            coordinates,
            padding_mode="border",
            align_corners=False,
        )
        mean = box_mean(warped, WINDOW)
        variance = _variance(warped, mean)
        covariance = (box_mean(warped * self.image, WINDOW) - mean * self.mean).sum(1)
        noise = COLOUR_NOISE * len(image)
        correlation = covariance * ((variance + noise) * (self.variance + noise)).rsqrt()
        return torch.where(inside, (1 - correlation.clamp(-1, 1)) / 2, torch.inf)


def _variance(image: Float[Tensor, "d c h w"], mean: Tensor) -> Float[Tensor, "d h w"]:
    return (box_mean(image.square(), WINDOW) - mean.square()).clamp_min(0).sum(1)
