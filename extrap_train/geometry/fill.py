"""Smooth completion of holes, so that a network never sees an arbitrary constant where nothing is
known.
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional


def fill_holes(
    image: Float[Tensor, "b c h w"], mask: Float[Tensor, "b h w"]
) -> Float[Tensor, "b c h w"]:
    """Fill where `mask` is 0 by pull-push (Gortler et al., The Lumigraph, 1996, section 3.4.1).

    Known pixels are averaged down a pyramid until no hole is left, then each hole takes the coarser
    level's colour. Known pixels stay exactly as they are; an image without any known pixel becomes
    0.
    """
    weight = mask[:, None].to(image.dtype)
    height, width = image.shape[-2:]
    if min(height, width) == 1 or bool((weight > 0).all()):
        return torch.where(weight > 0, image, _weighted_mean(image, weight))
    padded = (0, width % 2, 0, height % 2)
    colours = functional.avg_pool2d(functional.pad(image * weight, padded), 2)
    coverage = functional.avg_pool2d(functional.pad(weight, padded), 2)
    coarse = colours / coverage.clamp_min(1e-8)
    filled = fill_holes(coarse, (coverage[:, 0] > 0).to(image.dtype))
    up = functional.interpolate(filled, scale_factor=2.0, mode="bilinear", align_corners=False)
    return torch.where(weight > 0, image, up[..., :height, :width])


def _weighted_mean(
    image: Float[Tensor, "b c h w"], weight: Float[Tensor, "b 1 h w"]
) -> Float[Tensor, "b c 1 1"]:
    total = (image * weight).sum((-2, -1), keepdim=True)
    return total / weight.sum((-2, -1), keepdim=True).clamp_min(1e-8)
