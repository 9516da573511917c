"""How alike two pictures are, window by window."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

WINDOW = 7
LEAST_CORRELATION = 0.5
"""From here on two windows show the same."""
NOISE_VARIANCE = 4e-4
"""Variance of brightness (5/255 squared) below which a window has nothing to compare."""


def alike(
    image: Float[Tensor, "3 h w"], other: Float[Tensor, "3 h w"], mask: Bool[Tensor, "h w"]
) -> tuple[Bool[Tensor, "h w"], Bool[Tensor, "h w"]]:
    """Where the windows around a pixel correlate, and where there is anything to compare.

    Zero-mean normalised cross-correlation of brightness over the masked pixels of a window, of
    which at least half must be there.
    """
    weight = mask.to(image.dtype)
    count = _box(weight).clamp(min=1e-6)
    a, b = image.mean(0), other.mean(0)
    mean_a, mean_b = _box(a * weight) / count, _box(b * weight) / count
    variance_a = _box(a.square() * weight) / count - mean_a.square()
    variance_b = _box(b.square() * weight) / count - mean_b.square()
    covariance = _box(a * b * weight) / count - mean_a * mean_b
    spread = (variance_a.clamp(min=1e-12) * variance_b.clamp(min=1e-12)).sqrt()
    comparable = mask & (count > 0.5) & (torch.maximum(variance_a, variance_b) > NOISE_VARIANCE)
    return (covariance / spread > LEAST_CORRELATION) & comparable, comparable


def _box(image: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    return functional.avg_pool2d(image[None, None], WINDOW, 1, WINDOW // 2)[0, 0]
