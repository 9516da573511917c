"""From Gaussians in the world to ellipses on the image plane (EWA splatting)."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from extrap_train.gaussians.projection_numba import pose_blocks, project_backward, project_forward
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
