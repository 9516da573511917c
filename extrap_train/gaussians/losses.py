"""Losses against the photographs, and against depth that is known up to an affine map only."""

import math
from dataclasses import dataclass
from functools import cache

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

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


def blur(maps: Float[Tensor, "*b h w"]) -> Float[Tensor, "*b h w"]:
    """The 11×11 Gaussian window (σ 1.5 pixels) of SSIM, zeros beyond the border."""
    height, width = maps.shape[-2:]
    down = _blur_matrix(height, maps.dtype, maps.device)
    return down @ maps @ _blur_matrix(width, maps.dtype, maps.device)


@dataclass(frozen=True)
class PreparedTruth:
    """A truth with the moments of its windows, which stay the same over a whole training."""

    image: Float[Tensor, "3 h w"]
    mean: Float[Tensor, "3 h w"]
    variance: Float[Tensor, "3 h w"]


def prepare_truth(image: Float[Tensor, "3 h w"]) -> PreparedTruth:
    """Compute once what comparing pictures with a photograph needs."""
    mean = blur(image)
    return PreparedTruth(image, mean, blur(image.square()) - mean.square())


def ssim_map(image: Float[Tensor, "3 h w"], truth: PreparedTruth) -> Float[Tensor, "3 h w"]:
    """Structural similarity (Wang et al., 2004) around each pixel, per channel; range 1."""
    mean, square, product = blur(torch.stack([image, image.square(), image * truth.image]))
    variance = square - mean.square()
    covariance = product - mean * truth.mean
    luminance = (2 * mean * truth.mean + _C1) / (mean.square() + truth.mean.square() + _C1)
    return luminance * (2 * covariance + _C2) / (variance + truth.variance + _C2)


def photometric_loss(
    image: Float[Tensor, "3 h w"], truth: PreparedTruth, ssim_weight: float, l1_weight: float
) -> Float[Tensor, ""]:
    """`l1_weight · L1 + ssim_weight · (1 − SSIM)`; 3DGS's weights add to 1, DNGaussian's do not."""
    l1 = (image - truth.image).abs().mean()
    return l1_weight * l1 + ssim_weight * (1 - ssim_map(image, truth).mean())


_MIN_SPREAD = 1e-6
_GLOBAL_SHARE = 0.01
"""Share of the image's spread that is added to a patch's own (DNGaussian, released code)."""


def pearson(first: Float[Tensor, " n"], second: Float[Tensor, " n"]) -> Float[Tensor, ""]:
    """Correlation in [−1, 1]; 0 where one of them is constant."""
    a, b = first - first.mean(), second - second.mean()
    spread = a.norm() * b.norm()
    return (a * b).sum() / spread.clamp_min(_MIN_SPREAD**2)


def pearson_depth_loss(
    depth: Float[Tensor, "h w"], prior: Float[Tensor, "h w"]
) -> Float[Tensor, ""]:
    """1 − correlation with the prior, read as depth or as what networks mistake for it.

    FSGS takes the better of two readings of a network's disparity (equation 8, released code): its
    negative and its inverse. With a prior in depth (0 unknown) these are −1/prior and the prior.
    """
    known = prior > 0
    if int(known.sum()) < 2:
        return depth.sum() * 0
    rendered, given = depth[known], prior[known]
    readings = [1 - pearson(rendered, given), 1 - pearson(rendered, -1 / given)]
    return torch.minimum(*readings)


def patches(image: Float[Tensor, "h w"], size: int) -> Float[Tensor, "p k"]:
    """The whole patches of `size`² pixels, side by side from the top left; the rest is left out."""
    rows, columns = image.shape[0] // size, image.shape[1] // size
    cut = image[: rows * size, : columns * size].reshape(rows, size, columns, size)
    return cut.permute(0, 2, 1, 3).reshape(rows * columns, size * size)


def normalised_patches(image: Float[Tensor, "h w"], size: int, local: bool) -> Float[Tensor, "p k"]:
    """Patches less their mean, over their own spread (local) or the image's (global).

    DNGaussian, section 3.3: the first shows small changes, the second keeps their relative size.
    """
    cut = patches(image, size)
    centred = cut - cut.mean(1, keepdim=True)
    whole = image.std()
    spread = cut.std(1, keepdim=True) if local else whole.detach()
    return centred / (spread + _GLOBAL_SHARE * whole).clamp_min(_MIN_SPREAD)


def patch_depth_loss(
    depth: Float[Tensor, "h w"],
    prior: Float[Tensor, "h w"],
    size: int,
    local: bool,
    tolerance: float,
) -> Float[Tensor, ""]:
    """Mean squared difference of normalised patches, over those pixels that differ by more than
    `tolerance`; 0 where none does.
    """
    size = min(size, *depth.shape)
    difference = normalised_patches(depth, size, local) - normalised_patches(prior, size, local)
    beyond = difference.abs() > tolerance
    return (difference.square() * beyond).sum() / beyond.sum().clamp_min(1)


def fill_unknown(prior: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """The prior with unknown pixels (0) at their neighbours' mean, nearer neighbours first.

    Patch losses look at every pixel, and a network's prior has no holes; other sources' do.
    """
    known = (prior > 0).to(prior.dtype)
    if not known.any() or known.all():
        return prior
    value, weight = prior * known, known
    while not (weight > 0).all():
        both = torch.stack([value, weight])[None]
        spread = functional.avg_pool2d(both, 3, stride=1, padding=1, count_include_pad=False)[0]
        mean = spread[0] / spread[1].clamp_min(1e-12)
        new = (weight == 0) & (spread[1] > 0)
        value, weight = torch.where(new, mean, value), torch.where(new, 1.0, weight)
    return value
