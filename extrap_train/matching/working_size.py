"""Pictures at the size that a matcher works at, and its pixels back in theirs."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

LUMA = (0.299, 0.587, 0.114)
"""Weights of the colours in a grey picture (Rec. 601)."""


def to_grey(image: Float[Tensor, "3 h w"]) -> Float[Tensor, "h w"]:
    """Brightness in [0, 1]."""
    return torch.einsum("chw,c->hw", image, image.new_tensor(LUMA))


def resize(planes: Float[Tensor, "c h w"], height: int, width: int) -> Float[Tensor, "c h2 w2"]:
    """Resampled, with averaging where it shrinks."""
    shrinks = height < planes.shape[1] or width < planes.shape[2]
    return functional.interpolate(
        planes[None], (height, width), mode="bicubic", antialias=shrinks, align_corners=False
    )[0].clamp(0, 1)


def to_image_pixels(
    indices: Float[Tensor, "n 2"], working: torch.Size, size: torch.Size
) -> Float[Tensor, "n 2"]:
    """Pixels (u, v), centres at +0.5, of a picture whose shape `size` ends in height and width.

    `indices` are (column, row) in its copy of shape `working`, with centres at whole numbers, as
    libraries of networks count them.
    """
    ratio = indices.new_tensor([size[-1] / working[-1], size[-2] / working[-2]])
    return (indices + 0.5) * ratio
