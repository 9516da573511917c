"""A dense matcher without weights: dense inverse search (Kroeger et al., ECCV 2016) from OpenCV,
there and back.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from torch.nn import functional

from extrap_train.config import FlowMatcherConfig
from extrap_train.geometry.cameras import pixel_grid
from extrap_train.geometry.ncc import windowed_correlation
from extrap_train.geometry.resample import fill_holes, sample_pixels
from extrap_train.matching import DenseFlow, Matches, resize, to_grey

MAX_ENLARGEMENT = 2.0
"""Enlarged twice, small pictures are matched to about a tenth of a pixel; more brings nothing."""
MAX_ERROR = 2.0
"""Forward-backward error, in pixels, from which both directions contradict each other."""
MIN_SIDE = 16
"""Smaller pictures have no room for the search's patches, and are padded."""


@dataclass(frozen=True)
class FlowMatcher:
    """Coarse to fine, robust to exposure, for displacements of up to about a tenth of the picture.

    Confidence is the normalised cross-correlation of the windows around both ends (0 without
    texture) times exp(−e²/2), with e the forward-backward error in pixels.
    """

    config: FlowMatcherConfig

    def match(
        self,
        first: Float[Tensor, "3 h w"],
        second: Float[Tensor, "3 h2 w2"],
        first_known: Bool[Tensor, "h w"] | None = None,
    ) -> Matches:
        """Every pixel of `first` whose way is confirmed on the way back."""
        return self.flow(first, second, first_known).matches()

    def flow(
        self,
        first: Float[Tensor, "3 h w"],
        second: Float[Tensor, "3 h2 w2"],
        first_known: Bool[Tensor, "h w"] | None = None,
    ) -> DenseFlow:
        """Where each pixel of `first` is in `second`; the result lies where `first` does."""
        colours, there = (image.detach().float().cpu() for image in (first, second))
        known = torch.ones_like(colours[0]) if first_known is None else first_known.float().cpu()
        filled = fill_holes(colours[None], known[None])[0]
        forward, backward = self._both_ways(to_grey(filled), to_grey(there))
        found, inside = _sample(torch.cat([there, backward]), forward)
        error = (forward + found[3:]).norm(dim=0)
        correlation = windowed_correlation(filled, found[:3], known)
        sure = inside & (known > 0) & (error < MAX_ERROR)
        confidence = torch.where(sure, correlation * (-error.square() / 2).exp(), 0)
        return DenseFlow(forward.permute(1, 2, 0).to(first), confidence.to(first))

    def _both_ways(
        self, first: Float[Tensor, "h w"], second: Float[Tensor, "h2 w2"]
    ) -> tuple[Float[Tensor, "2 h w"], Float[Tensor, "2 h2 w2"]]:
        scale = min(MAX_ENLARGEMENT, self.config.image_size / max(*first.shape, *second.shape))
        working = [_rescale(picture, scale) for picture in (first, second)]
        size = tuple(
            max(MIN_SIDE, *sides) for sides in zip(*(x.shape for x in working), strict=True)
        )
        a, b = (_bytes(_pad(picture, size)) for picture in working)
        return (
            _restore_flow(_inverse_search(a, b), working[0].shape, first.shape),
            _restore_flow(_inverse_search(b, a), working[1].shape, second.shape),
        )


def _inverse_search(
    first: UInt8[np.ndarray, "h w"], second: UInt8[np.ndarray, "h w"]
) -> Float[Tensor, "2 h w"]:
    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    search.setFinestScale(0)
    start = np.zeros((*first.shape, 2), np.float32)
    return torch.from_numpy(search.calc(first, second, start)).permute(2, 0, 1)


def _rescale(picture: Float[Tensor, "h w"], scale: float) -> Float[Tensor, "h2 w2"]:
    height, width = (max(1, round(side * scale)) for side in picture.shape)
    return resize(picture[None], height, width)[0]


def _pad(picture: Float[Tensor, "h w"], size: tuple[int, ...]) -> Float[Tensor, "h2 w2"]:
    below, right = size[0] - picture.shape[0], size[1] - picture.shape[1]
    return functional.pad(picture[None, None], (0, right, 0, below), mode="replicate")[0, 0]


def _bytes(picture: Float[Tensor, "h w"]) -> UInt8[np.ndarray, "h w"]:
    return picture.mul(255).round().clamp(0, 255).to(torch.uint8).numpy()


def _restore_flow(
    flow: Float[Tensor, "2 h w"], working: torch.Size, size: torch.Size
) -> Float[Tensor, "2 h2 w2"]:
    """The flow of the working picture's part, in pixels of the picture of `size`."""
    part = flow[:, : working[0], : working[1]]
    resampled = functional.interpolate(
        part[None], size, mode="bilinear", antialias=True, align_corners=False
    )[0]
    ratio = resampled.new_tensor([size[1] / working[1], size[0] / working[0]])
    return resampled * ratio[:, None, None]


def _sample(
    planes: Float[Tensor, "c h2 w2"], flow: Float[Tensor, "2 h w"]
) -> tuple[Float[Tensor, "c h w"], Bool[Tensor, "h w"]]:
    """`planes` where the flow leads, and whether that lies inside them."""
    size = flow.new_tensor([planes.shape[2], planes.shape[1]])
    there = pixel_grid(*flow.shape[1:]) + flow.permute(1, 2, 0)
    inside = ((there >= 0) & (there <= size)).all(-1)
    return sample_pixels(planes, there), inside
