"""Smooth completion of holes, so that a network never sees an arbitrary constant where nothing is
known.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

_COARSEST_CELLS = 16
"""On the shorter side of the coarsest level, about.

Measured on held-out views: what lies beyond a hole wider than 1/16 of the picture is rather like
the picture's mean than like the hole's rim, which is mostly the object's.
"""


def fill_holes(
    image: Float[Tensor, "b c h w"], mask: Float[Tensor, "b h w"]
) -> Float[Tensor, "b c h w"]:
    """Fill where `mask` is 0: narrow holes from their rim, wide ones with the mean of the known.

    Pull-push (Gortler et al., The Lumigraph, 1996, section 3.4.1) down to `_COARSEST_CELLS` a side:
    known pixels are averaged level by level, and each hole takes the finest level's colour that
    reaches it. Known pixels stay exactly as they are; an image without any becomes 0.
    """
    weight = mask[:, None].to(image.dtype)
    total = weight.sum((-2, -1), keepdim=True).clamp_min(1e-8)
    mean = (image * weight).sum((-2, -1), keepdim=True) / total
    levels = max(0, round(math.log2(min(image.shape[-2:]) / _COARSEST_CELLS)))
    return _pull_push(image, weight, mean, levels)


def _pull_push(
    image: Float[Tensor, "b c h w"],
    weight: Float[Tensor, "b 1 h w"],
    mean: Float[Tensor, "b c 1 1"],
    levels: int,
) -> Float[Tensor, "b c h w"]:
    if levels == 0:
        return torch.where(weight > 0, image, mean)
    height, width = image.shape[-2:]
    padded = (0, width % 2, 0, height % 2)
    colours = functional.avg_pool2d(functional.pad(image * weight, padded), 2)
    coverage = functional.avg_pool2d(functional.pad(weight, padded), 2)
    known = (coverage > 0).to(image.dtype)
    filled = _pull_push(colours / coverage.clamp_min(1e-8), known, mean, levels - 1)
    up = functional.interpolate(filled, scale_factor=2.0, mode="bilinear", align_corners=False)
    return torch.where(weight > 0, image, up[..., :height, :width])
