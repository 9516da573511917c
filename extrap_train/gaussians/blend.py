"""Blending as a differentiable function of torch tensors."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from extrap_train.gaussians.blend_numba import blend, blend_backward
from extrap_train.gaussians.projection import Ellipses, array
from extrap_train.gaussians.tiles_numba import (
    CHANNELS,
    COLUMNS,
    MOMENTS,
    REACH,
    pack,
    sort_into_tiles,
    unpack,
)


def blend_ellipses(
    ellipses: Ellipses,
    opacities: Float[Tensor, " n"],
    features: Float[Tensor, "n d"],
    background: Float[Tensor, " d"],
    height: int,
    width: int,
) -> tuple[Float[Tensor, "h w d"], Float[Tensor, "h w"]]:
    """The image Σ wᵢ·featuresᵢ + T·background, and the transmittance T that is left.

    Front to back, wᵢ = αᵢ·Π(1 − αⱼ), with α at most 0.999, left out below 1/255, and ending before
    T would fall to 10⁻⁴ (Kerbl et al. 2023, §6 and appendix C). The order by depth and the radii
    have no gradient.
    """
    geometry = (ellipses.means, ellipses.shapes, opacities)
    sorting = (ellipses.radii, ellipses.depths, (height, width))
    images = []
    for some, behind in zip(features.split(CHANNELS, 1), background.split(CHANNELS), strict=True):
        image, transmittance = _Blend.apply(*geometry, some, behind, *sorting)
        images.append(image)
    return torch.cat(images, -1) if len(images) > 1 else images[0], transmittance


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        shapes: Tensor,
        opacities: Tensor,
        features: Tensor,
        background: Tensor,
        radii: Tensor,
        depths: Tensor,
        size: tuple[int, int],
    ) -> tuple[Tensor, Tensor]:
        height, width = size
        packed = array(means.new_empty(len(means), COLUMNS))
        pack(*(array(x) for x in (means, shapes, opacities, features, radii)), packed)
        reaches = packed[:, REACH : REACH + 2]
        tiles = sort_into_tiles(array(means), reaches, array(depths), width, height)
        image = means.new_empty(height, width, features.shape[1])
        transmittance, ends = means.new_empty(size), np.empty(size, np.int32)
        out = (array(image), array(transmittance), ends)
        blend(packed, array(background), tiles.starts, tiles.gaussians, *out)
        ctx.save_for_backward(shapes, opacities, background, transmittance)
        ctx.packed, ctx.tiles, ctx.ends = packed, tiles, ends
        return image, transmittance

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, image_grad: Tensor, transmittance_grad: Tensor
    ) -> tuple[Tensor | None, ...]:
        shapes, opacities, background, transmittance = ctx.saved_tensors
        tiles, packed = ctx.tiles, ctx.packed
        moments = np.empty((len(tiles.slots), MOMENTS), packed.dtype)
        blend_backward(
            packed,
            array(background),
            tiles.starts,
            tiles.gaussians,
            tiles.slots,
            array(transmittance),
            ctx.ends,
            array(image_grad),
            array(transmittance_grad),
            moments,
        )
        n, channels = len(shapes), image_grad.shape[-1]
        grads = [shapes.new_empty(extent) for extent in ((n, 2), (n, 3), (n,), (n, channels))]
        gradients = (array(x) for x in grads)
        unpack(tiles.slot_starts, moments, array(shapes), array(opacities), *gradients)
        background_grad = torch.einsum("hwd,hw->d", image_grad, transmittance)
        return *grads, background_grad, None, None, None
