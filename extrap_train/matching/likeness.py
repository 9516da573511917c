"""How alike two aligned pictures are around each pixel."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

WINDOW = 7
"""Side of the window that is compared, in pixels."""
NOISE_VARIANCE = 5e-6
"""Variance of a colour channel (0.6/255 squared) that counts as noise, not as texture."""
LEAST_KNOWN = 0.5
"""Of a window, for it to say anything."""


def windowed_correlation(
    first: Float[Tensor, "c h w"], second: Float[Tensor, "c h w"], known: Float[Tensor, "h w"]
) -> Float[Tensor, "h w"]:
    """Zero-mean normalised cross-correlation of the windows around each pixel, cut off below 0.

    Of each channel, averaged. Only pixels with `known` 1 count. Brightness and contrast do not
    matter; a window without texture, or of which less than half is known, is like nothing: 0.
    """
    share = _mean(known[None])

    def mean(values: Float[Tensor, "c h w"]) -> Float[Tensor, "c h w"]:
        return _mean(values * known) / share.clamp_min(1e-6)

    # Around the overall mean, the difference of two moments is exact enough in single precision.
    total = known.sum().clamp_min(1)
    a, b = (x - (x * known).sum((1, 2), keepdim=True) / total for x in (first, second))
    mean_a, mean_b = mean(a), mean(b)
    covariance = mean(a * b) - mean_a * mean_b
    variances = [mean(a.square()) - mean_a.square(), mean(b.square()) - mean_b.square()]
    noise = NOISE_VARIANCE
    scale = ((variances[0].clamp_min(0) + noise) * (variances[1].clamp_min(0) + noise)).sqrt()
    correlation = (covariance / scale).mean(0).clamp(0, 1)
    return torch.where(share[0] >= LEAST_KNOWN, correlation, 0)


def _mean(values: Float[Tensor, "c h w"]) -> Float[Tensor, "c h w"]:
    return functional.avg_pool2d(values[None], WINDOW, 1, WINDOW // 2, count_include_pad=False)[0]
