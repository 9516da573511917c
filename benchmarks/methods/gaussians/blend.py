"""Blending as a differentiable function of torch tensors."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from benchmarks.methods.gaussians.arrays import array
from benchmarks.methods.gaussians.blend_numba import (
    FEATURES,
    MEAN,
    OPACITY,
    SHAPE,
    add_slots,
    blend,
    blend_backward,
)
from benchmarks.methods.gaussians.projection import Ellipses
from benchmarks.methods.gaussians.tiles_numba import sort_into_tiles


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
    return _Blend.apply(
        ellipses.means,
        ellipses.shapes,
        opacities,
        features,
        background,
        ellipses.radii,
        ellipses.depths,
        (height, width),
    )


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
        inputs = [array(x) for x in (means, shapes, opacities, features, background)]
        height, width = size
        tiles = sort_into_tiles(inputs[0], array(radii), array(depths), width, height)
        image = means.new_empty(height, width, features.shape[1])
        transmittance = means.new_empty(height, width)
        ends = np.empty(size, np.int64)
        out = (image.numpy(), transmittance.numpy(), ends)
        blend(*inputs, tiles.starts, tiles.gaussians, *out)
        ctx.save_for_backward(means, shapes, opacities, features, background, transmittance)
        ctx.tiles, ctx.ends = tiles, ends
        return image, transmittance

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, image_grad: Tensor, transmittance_grad: Tensor
    ) -> tuple[Tensor | None, ...]:
        *inputs, transmittance = (array(x) for x in ctx.saved_tensors)
        tiles, features = ctx.tiles, inputs[3]
        columns = FEATURES + features.shape[1]
        slot_grads = np.zeros((len(tiles.slots), columns), features.dtype)
        grads = image_grad.new_empty(len(features), columns)
        blend_backward(
            *inputs,
            tiles.starts,
            tiles.gaussians,
            tiles.slots,
            transmittance,
            ctx.ends,
            array(image_grad),
            array(transmittance_grad),
            slot_grads,
        )
        add_slots(tiles.slot_starts, slot_grads, grads.numpy())
        background_grad = torch.einsum("hwd,hw->d", image_grad, torch.from_numpy(transmittance))
        return (
            grads[:, MEAN:SHAPE],
            grads[:, SHAPE:OPACITY],
            grads[:, OPACITY],
            grads[:, FEATURES:],
            background_grad,
            None,
            None,
            None,
        )
