"""Softmax splatting of points by depth (paper Eq. 1): numba on the CPU, torch on the GPU and for
gradients."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.geometry.screen_points import OUTSIDE, ScreenPoints
from extrap_train.geometry.splat_numba import project_numba, splat_pixels_numba
from extrap_train.geometry.splat_torch import splat_pixels_torch
from extrap_train.views import Camera


@dataclass(frozen=True)
class Splat:
    """Splatted values, weighted means; zero where nothing landed (`weight` 0)."""

    values: Float[Tensor, "b c h w"]
    weight: Float[Tensor, "b h w"]
    """Σ b·exp(-β·z): bilinear coverage by the nearest surface."""


def splat(
    world_points: Float[Tensor, "n 3"], values: Float[Tensor, "n c"], camera: Camera
) -> Splat:
    """Draw a cloud of points as one (unbatched) camera sees it, each a bilinear dot; see
    `splat_pixels`."""
    pixels_from_world = camera.intrinsics @ camera.world_to_cam[:3]
    inputs = (world_points, values, pixels_from_world)
    project = _project if _needs_torch(*inputs) else project_numba
    u, v, depth = project(world_points, pixels_from_world)
    reach = torch.ones_like(depth)
    image = torch.zeros(len(depth), dtype=torch.long, device=depth.device)
    points = ScreenPoints(u, v, depth, reach, reach, image)
    return splat_pixels(points, values, 1, camera.height, camera.width)


def _project(
    world_points: Float[Tensor, "n 3"], pixels_from_world: Float[Tensor, "3 4"]
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"], Float[Tensor, "n"]]:
    # Term by term, as `project_numba` does: a matrix product rounds otherwise, and then a dot's
    # rim flips.
    x, y, z = world_points.unbind(-1)
    u, v, depth = (row[0] * x + row[1] * y + row[2] * z + row[3] for row in pixels_from_world)
    shown = depth > 0
    safe = torch.where(shown, depth, 1)
    return torch.where(shown, u / safe, OUTSIDE), torch.where(shown, v / safe, OUTSIDE), safe


def _needs_torch(*inputs: Tensor) -> bool:
    """Whether the numba kernels cannot: another device or precision, or gradients are wanted."""
    differentiated = torch.is_grad_enabled() and any(x.requires_grad for x in inputs)
    return differentiated or any(x.is_cuda or x.dtype != torch.float32 for x in inputs)


def splat_pixels(
    points: ScreenPoints, values: Float[Tensor, "n c"], images: int, height: int, width: int
) -> Splat:
    """Draw projected points into `images` images of `height` × `width`.

    Per pixel, `Σ b·e·v / Σ b·e` with the bilinear kernel b and `e = exp(−β |z/z_nearest − 1|)`,
    where z_nearest is the least depth of the points that reach the pixel's centre: it is the
    maximum that is subtracted and the unit that depth is measured in, so nothing overflows and
    nothing depends on the scene's scale. A point that touches the kernel but does not reach the
    centre blends in without making the silhouette grow; a pixel that no point reaches stays
    empty.

    On the CPU the same bits come out for any number of threads. The torch version agrees within
    rounding: it adds in another order, on CUDA in no fixed one.
    """
    in_torch = _needs_torch(points.u, points.depth, values)
    run = splat_pixels_torch if in_torch else splat_pixels_numba
    drawn = run(points, values, (images, height, width))
    return Splat(drawn[:, :-1], drawn[:, -1])
