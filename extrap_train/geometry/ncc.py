"""Zero-mean normalised cross-correlation (NCC) of the windows around corresponding pixels.

Brightness and contrast drop out: two windows that differ in exposure alone correlate by 1.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

WINDOW = 7
"""Side of the windows, in pixels."""
COLOUR_NOISE = 5e-6
"""Variance of a colour channel (0.6/255 squared) that counts as noise, not as texture."""
MIN_TEXTURE = 4e-4
"""Variance of brightness (5/255 squared) below which a window has nothing to compare."""
MIN_KNOWN = 0.5
"""Share of a window that must be known for it to say anything."""
CONSISTENT_CORRELATION = 0.5
"""From here on two windows show the same."""


def windowed_correlation(
    first: Float[Tensor, "c h w"], second: Float[Tensor, "c h w"], known: Float[Tensor, "h w"]
) -> Float[Tensor, "h w"]:
    """NCC of each channel, averaged, with negative values set to 0.

    Only pixels where `known` is 1 count. A window without texture, or of which less than half is
    known, gets 0.
    """
    window = _moments(first, second, known, border_is_known=True)
    variances = [v.clamp_min(0) + COLOUR_NOISE for v in (window.variance, window.other_variance)]
    correlation = window.covariance / (variances[0] * variances[1]).sqrt()
    return torch.where(window.known_share >= MIN_KNOWN, correlation.mean(0).clamp(0, 1), 0)


def ncc_consistent(
    first: Float[Tensor, "3 h w"], second: Float[Tensor, "3 h w"], known: Bool[Tensor, "h w"]
) -> tuple[Bool[Tensor, "h w"], Bool[Tensor, "h w"]]:
    """Where brightness correlates, and where there is enough known texture to compare."""
    weight = known.to(first.dtype)
    window = _moments(
        first.mean(0, keepdim=True), second.mean(0, keepdim=True), weight, border_is_known=False
    )
    variances = window.variance[0], window.other_variance[0]
    comparable = known & (window.known_share > MIN_KNOWN)
    comparable &= torch.maximum(*variances) > MIN_TEXTURE
    scale = (variances[0].clamp_min(1e-12) * variances[1].clamp_min(1e-12)).sqrt()
    return (window.covariance[0] / scale > CONSISTENT_CORRELATION) & comparable, comparable


def box_mean(image: Float[Tensor, "*d c h w"], window: int) -> Float[Tensor, "*d c h w"]:
    """Mean over the part of each window that lies inside the image: rows, then columns."""
    half = window // 2
    rows = functional.avg_pool2d(image, (window, 1), 1, (half, 0), count_include_pad=False)
    return functional.avg_pool2d(rows, (1, window), 1, (0, half), count_include_pad=False)


@dataclass(frozen=True)
class _Moments:
    covariance: Float[Tensor, "c h w"]
    variance: Float[Tensor, "c h w"]
    other_variance: Float[Tensor, "c h w"]
    known_share: Float[Tensor, "h w"]


def _moments(
    first: Float[Tensor, "c h w"],
    second: Float[Tensor, "c h w"],
    known: Float[Tensor, "h w"],
    border_is_known: bool,
) -> _Moments:
    """Moments of the known pixels of each window.

    With `border_is_known` what lies outside the image is left out of a window; without, it is an
    unknown part of it.
    """

    def pooled(values: Float[Tensor, "c h w"]) -> Float[Tensor, "c h w"]:
        return functional.avg_pool2d(
            values[None], WINDOW, 1, WINDOW // 2, count_include_pad=not border_is_known
        )[0]

    share = pooled(known[None])

    def mean(values: Float[Tensor, "c h w"]) -> Float[Tensor, "c h w"]:
        return pooled(values * known) / share.clamp_min(1e-6)

    # Around the overall mean, the difference of two moments is exact enough in single precision.
    total = known.sum().clamp_min(1)
    a, b = (x - (x * known).sum((1, 2), keepdim=True) / total for x in (first, second))
    mean_a, mean_b = mean(a), mean(b)
    return _Moments(
        mean(a * b) - mean_a * mean_b,
        mean(a.square()) - mean_a.square(),
        mean(b.square()) - mean_b.square(),
        share[0],
    )
