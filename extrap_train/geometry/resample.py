"""Images at other places and sizes."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from extrap_train.views import send

_LOBES = 3


def sample_pixels(
    planes: Float[Tensor, "c h w"], pixels: Float[Tensor, "*n 2"]
) -> Float[Tensor, "c ..."]:
    """Bilinear samples at (u, v), centres at +0.5; outside the image those of its border."""
    size = pixels.new_tensor([planes.shape[2], planes.shape[1]])
    at = (pixels / size * 2 - 1).reshape(1, 1, -1, 2)
    found = functional.grid_sample(planes[None], at, padding_mode="border", align_corners=False)
    return found.reshape(len(planes), *pixels.shape[:-1])


def lanczos_resize(
    image: Float[Tensor, "*b h w"], height: int, width: int
) -> Float[Tensor, "*b height width"]:
    """The image resampled by a Lanczos-3 kernel as wide as the coarser of the two grids.

    Pillow's `LANCZOS` without its rounding to 8 bits; values may over- and undershoot.
    """
    rows = send(_weights(image.shape[-2], height), image)
    columns = send(_weights(image.shape[-1], width), image)
    return rows @ image @ columns.mT


def _weights(source: int, target: int) -> Float[Tensor, "target source"]:
    """Row by row what each target pixel takes of every source pixel; rows sum to 1."""
    scale = source / target
    stretch = max(scale, 1.0)
    centers = (torch.arange(target, dtype=torch.float64) + 0.5) * scale
    offsets = (torch.arange(source, dtype=torch.float64) + 0.5 - centers[:, None]) / stretch
    kernel = torch.sinc(offsets) * torch.sinc(offsets / _LOBES) * (offsets.abs() < _LOBES)
    return kernel / kernel.sum(1, keepdim=True)
