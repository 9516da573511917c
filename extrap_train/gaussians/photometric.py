"""The photometric loss of 3DGS: L1 and structural dissimilarity."""

import math
from dataclasses import dataclass
from functools import cache

import torch
from jaxtyping import Float
from torch import Tensor

_WINDOW, _SIGMA = 11, 1.5
_C1, _C2 = 0.01**2, 0.03**2


@cache
def _blur_matrix(size: int, dtype: torch.dtype, device: torch.device) -> Float[Tensor, "s s"]:
    """The Gaussian window as a banded matrix: for images of a few hundred pixels two matrix
    products are several times faster than a convolution. Outside the image is zero.
    """
    offset = torch.arange(size)[:, None] - torch.arange(size)[None]
    taps = torch.arange(_WINDOW) - _WINDOW // 2
    total = sum(math.exp(-(int(tap) ** 2) / (2 * _SIGMA**2)) for tap in taps)
    weights = torch.exp(-offset.double().square() / (2 * _SIGMA**2)) / total
    return torch.where(offset.abs() <= _WINDOW // 2, weights, 0).to(device, dtype)


def blurred(maps: Float[Tensor, "*b h w"]) -> Float[Tensor, "*b h w"]:
    """The 11×11 Gaussian window (σ 1.5 pixels) of SSIM, zeros beyond the border."""
    height, width = maps.shape[-2:]
    down = _blur_matrix(height, maps.dtype, maps.device)
    return down @ maps @ _blur_matrix(width, maps.dtype, maps.device)


@dataclass(frozen=True)
class Photograph:
    """A truth with the moments of its windows, which stay the same over a whole training."""

    image: Float[Tensor, "3 h w"]
    mean: Float[Tensor, "3 h w"]
    variance: Float[Tensor, "3 h w"]


def photograph(image: Float[Tensor, "3 h w"]) -> Photograph:
    """Prepare a photograph to be compared with."""
    mean = blurred(image)
    return Photograph(image, mean, blurred(image.square()) - mean.square())


def ssim_map(image: Float[Tensor, "3 h w"], truth: Photograph) -> Float[Tensor, "3 h w"]:
    """Structural similarity (Wang et al., 2004) around each pixel, per channel; range 1."""
    mean, square, product = blurred(torch.stack([image, image.square(), image * truth.image]))
    variance = square - mean.square()
    covariance = product - mean * truth.mean
    luminance = (2 * mean * truth.mean + _C1) / (mean.square() + truth.mean.square() + _C1)
    return luminance * (2 * covariance + _C2) / (variance + truth.variance + _C2)


def photometric_loss(
    image: Float[Tensor, "3 h w"], truth: Photograph, ssim_weight: float, l1_weight: float
) -> Float[Tensor, ""]:
    """`l1_weight · L1 + ssim_weight · (1 − SSIM)`; 3DGS's weights add to 1, DNGaussian's do not."""
    l1 = (image - truth.image).abs().mean()
    return l1_weight * l1 + ssim_weight * (1 - ssim_map(image, truth).mean())
