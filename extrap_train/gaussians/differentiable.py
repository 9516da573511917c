"""From Gaussians in the world to ellipses on the image plane (EWA splatting), and from these to an
image: the compiled kernels as differentiable functions of torch tensors.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from extrap_train.gaussians.blend_numba import blend, blend_backward
from extrap_train.gaussians.projection_numba import pose_blocks, project_backward, project_forward
from extrap_train.gaussians.tiles_numba import (
    CHANNELS,
    COLUMNS,
    MOMENTS,
    REACH,
    pack,
    sort_into_tiles,
    unpack,
)
from extrap_train.views import Camera


def array(tensor: Float[Tensor, "*b"]) -> Float[np.ndarray, "*b"]:
    """The tensor's own memory where it is contiguous, else a contiguous copy."""
    return tensor.detach().contiguous().numpy()


NEAR_PLANE = 0.01
LOW_PASS = 0.3
"""Variance in px² that every ellipse gains, so that none falls between the pixels."""


@dataclass(frozen=True)
class Ellipses:
    """Gaussians on the image plane of one camera.

    A pixel centre at (dx, dy) from the mean has the exponent ½·(a·(dx − m·dy)² + q·dy²), with
    `shapes` = (a, m, q): precision along x within a row, slope of the centre line, precision
    along y. This is the conic's LDLᵀ factorisation, which keeps its precision where the ellipse
    is thin and long.
    """

    means: Float[Tensor, "n 2"]
    shapes: Float[Tensor, "n 3"]
    depths: Float[Tensor, " n"]
    radii: Float[Tensor, "n 2"]
    """Half the extent in whole px of where alpha can reach 1/255; zero for what is not drawn."""


def project(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    opacities: Float[Tensor, " n"],
    camera: Camera,
    near_plane: float = NEAR_PLANE,
    low_pass: float = LOW_PASS,
) -> Ellipses:
    """Project by the local affine approximation at each mean (Zwicker et al. 2001).

    What lies before the near plane or outside the image, what is too transparent to be seen, and
    what is not a number, is not drawn and gets no gradient. The intrinsics get none either.
    """
    lens = (
        array(camera.world_to_cam.double()),
        array(camera.intrinsics.double()),
        camera.width,
        camera.height,
        near_plane,
        low_pass,
    )
    return Ellipses(*_Project.apply(means, quats, scales, opacities, camera.world_to_cam, lens))


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        opacities: Tensor,
        world_to_cam: Tensor,
        lens: tuple,
    ) -> tuple[Tensor, ...]:
        n = len(means)
        found = tuple(means.new_empty(size) for size in ((n, 2), (n, 3), (n,), (n, 2)))
        inputs = (means, quats, scales, opacities)
        project_forward(*(array(x) for x in inputs), lens, *(array(x) for x in found))
        ctx.save_for_backward(means, quats, scales, found[3])
        ctx.lens = lens
        ctx.mark_non_differentiable(found[3])
        return found

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, means2d_grad: Tensor, shapes_grad: Tensor, depths_grad: Tensor, _: Tensor
    ) -> tuple[Tensor | None, ...]:
        means, quats, scales, radii = ctx.saved_tensors
        grads = [x.new_empty(x.shape) for x in (means, quats, scales)]
        pose_grads = np.zeros((pose_blocks(len(means)), 3, 4))
        project_backward(
            *(array(x) for x in (means, quats, scales)),
            ctx.lens,
            *(array(x) for x in (radii, means2d_grad, shapes_grad, depths_grad, *grads)),
            pose_grads,
        )
        pose_grad = means.new_zeros(4, 4)
        pose_grad[:3] = torch.from_numpy(pose_grads.sum(0))
        return *grads, None, pose_grad, None


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
