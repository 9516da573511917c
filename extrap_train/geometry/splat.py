"""Softmax splatting of points by depth (paper Eq. 1): numba on the CPU, torch on the GPU and for gradients."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.geometry.splat_kernel import ScreenPoints
from extrap_train.geometry.splat_numba import splat_pixels_numba
from extrap_train.geometry.splat_torch import splat_pixels_torch


@dataclass(frozen=True)
class Splat:
    """Splatted values, weighted means; zero where nothing landed (`weight` 0)."""

    values: Float[Tensor, "b h w c"]
    weight: Float[Tensor, "b h w"]
    """Σ b·exp(−β·z): bilinear coverage by the nearest surface."""


def splat_pixels(
    points: ScreenPoints, values: Float[Tensor, "n c"], images: int, height: int, width: int
) -> Splat:
    """Draw projected points into `images` images of `height` × `width`.

    Per pixel, `Σ b·e·v / Σ b·e` with the bilinear kernel b and `e = exp(−β |z/z_nearest − 1|)`, where z_nearest
    is the least depth of the points that reach the pixel's centre: it is the maximum that is subtracted and the
    unit that depth is measured in, so nothing overflows and nothing depends on the scene's scale. A point that
    touches the kernel but does not reach the centre blends in without making the silhouette grow; a pixel that
    no point reaches stays empty.

    On the CPU the same bits come out for any number of threads. The torch version agrees within rounding: it
    adds in another order, on CUDA in no fixed one.
    """
    differentiated = points.u.requires_grad or values.requires_grad
    in_torch = points.u.is_cuda or points.u.dtype != torch.float32 or differentiated
    run = splat_pixels_torch if in_torch else splat_pixels_numba
    summed = run(points, values, (images, height, width))
    weight = summed[..., -1]
    mean = summed[..., :-1] / torch.where(weight > 0, weight, 1)[..., None]
    return Splat(mean, weight)
