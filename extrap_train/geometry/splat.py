"""Softmax splatting of points by depth (paper Eq. 1): numba on the CPU, torch on the GPU and for gradients."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from extrap_train.geometry.splat_numba import splat_pixels_numba
from extrap_train.geometry.splat_torch import splat_pixels_torch
from extrap_train.views import Camera

FRONT_OF_CAMERA = 1e-6
"""Least depth of a point that is drawn, as a share of the farthest one's."""


@dataclass(frozen=True)
class ScreenPoints:
    """Points seen by cameras of one image size: `image` says by which, in ascending order."""

    u: Float[Tensor, "n"]
    v: Float[Tensor, "n"]
    depth: Float[Tensor, "n"]
    """Positive."""
    image: Int[Tensor, "n"]


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

    Per pixel, `Σ b·e·v / Σ b·e` with the bilinear kernel b and `e = exp(−β (z/z_nearest − 1))`: the pixel's
    nearest point is the maximum that is subtracted and the unit that depth is measured in, so nothing overflows
    and nothing depends on the scene's scale. On the CPU the same bits come out for any number of threads. The
    torch version agrees within rounding only: it adds in another order, on CUDA in no fixed one.
    """
    needs_torch = (
        points.u.is_cuda
        or points.u.dtype != torch.float32
        or (torch.is_grad_enabled() and (points.u.requires_grad or values.requires_grad))
    )
    run = splat_pixels_torch if needs_torch else splat_pixels_numba
    summed = run(points.u, points.v, points.depth, points.image, values, (images, height, width))
    weight = summed[..., -1]
    mean = summed[..., :-1] / torch.where(weight > 0, weight, 1)[..., None]
    return Splat(mean, weight)
