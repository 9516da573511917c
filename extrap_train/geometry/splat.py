"""Softmax splatting of points by depth (paper Eq. 1): numba on the CPU, torch on the GPU and for
gradients.

Per pixel, `Σ b·e·v / Σ b·e` with the bilinear kernel b and `e = exp(−β |z/z_nearest − 1|)`, where
z_nearest is the least depth of the points that reach the pixel's centre: it is the maximum that is
subtracted and the unit that depth is measured in, so nothing overflows and nothing depends on the
scene's scale. A point that touches the kernel but does not reach the centre blends in without
making the silhouette grow; a pixel that no point reaches stays empty.

On the CPU the same bits come out for any number of threads. The torch version agrees within
rounding: it adds in another order, on CUDA in no fixed one.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.geometry.splat_numba import project_numba, splat_numba
from extrap_train.geometry.splat_torch import OUTSIDE, ScreenPoints, splat_torch
from extrap_train.views import Camera


@dataclass(frozen=True)
class Splat:
    """A drawn cloud; zero where nothing landed."""

    means: Float[Tensor, "c1 h w"]
    """The values, then the weight."""

    @property
    def values(self) -> Float[Tensor, "c h w"]:
        """Means of what the points carry."""
        return self.means[:-1]

    @property
    def weight(self) -> Float[Tensor, "h w"]:
        """Σ b·e: bilinear coverage by the nearest surface."""
        return self.means[-1]


def splat(
    world_points: Float[Tensor, "n 3"], values: Float[Tensor, "n c"], camera: Camera
) -> Splat:
    """Draw a cloud of points as one (unbatched) camera sees it, each a bilinear dot."""
    pixels_from_world = camera.intrinsics @ camera.world_to_cam[:3]
    if needs_torch(world_points, values, pixels_from_world):
        points = _project(world_points, pixels_from_world)
        means = splat_torch(points, values, (1, camera.height, camera.width))
    else:
        means = splat_numba(
            project_numba(world_points, pixels_from_world),
            np.ones((2, 1), np.float32),
            values.detach().contiguous().numpy(),
            np.array([[[0, len(values)]]]),
            camera.height,
            camera.width,
        )
    return Splat(means[0])


def _project(
    world_points: Float[Tensor, "n 3"], pixels_from_world: Float[Tensor, "3 4"]
) -> ScreenPoints:
    # Term by term, as `project_numba` does: a matrix product rounds otherwise, and then a dot's
    # rim flips.
    x, y, z = world_points.unbind(-1)
    u, v, depth = (row[0] * x + row[1] * y + row[2] * z + row[3] for row in pixels_from_world)
    shown = depth > 0
    depth = torch.where(shown, depth, 1)
    u, v = torch.where(shown, u / depth, OUTSIDE), torch.where(shown, v / depth, OUTSIDE)
    reach = torch.ones_like(depth)
    return ScreenPoints(u, v, depth, reach, reach, torch.zeros_like(depth, dtype=torch.long))


def needs_torch(*inputs: Tensor) -> bool:
    """Whether the numba kernels cannot: another device or precision, or gradients are wanted."""
    differentiated = torch.is_grad_enabled() and any(x.requires_grad for x in inputs)
    return differentiated or any(x.is_cuda or x.dtype != torch.float32 for x in inputs)
