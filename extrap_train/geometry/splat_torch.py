"""Softmax splatting in torch: on any device, differentiable in positions, depth and values."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from extrap_train.geometry.splat_kernel import DEPTH_SHARPNESS, LEAST_KERNEL


def splat_pixels_torch(
    u: Float[Tensor, "n"],
    v: Float[Tensor, "n"],
    depth: Float[Tensor, "n"],
    image: Int[Tensor, "n"],
    values: Float[Tensor, "n c"],
    size: tuple[int, int, int],
) -> Float[Tensor, "b h w c1"]:
    """Weighted sums of the values, and the summed weight as the last channel, for `size` = (b, h, w)."""
    pixel, point, kernel = _footprints(u, v, image, size)
    b, h, w = size
    z = depth[point]
    nearest = torch.full((b * h * w,), torch.inf, device=u.device, dtype=u.dtype)
    nearest = nearest.scatter_reduce(0, pixel, z.detach(), "amin")[pixel]
    weight = kernel * torch.exp(-DEPTH_SHARPNESS * (z - nearest) / nearest)
    rows = torch.cat([values[point] * weight[:, None], weight[:, None]], 1)
    summed = torch.zeros(b * h * w, rows.shape[1], device=u.device, dtype=rows.dtype)
    return summed.index_add(0, pixel, rows).reshape(b, h, w, -1)


def _footprints(
    u: Float[Tensor, "n"],
    v: Float[Tensor, "n"],
    image: Int[Tensor, "n"],
    size: tuple[int, int, int],
) -> tuple[Int[Tensor, "m"], Int[Tensor, "m"], Float[Tensor, "m"]]:
    """Pairs of a pixel (flat index) and a point that touches it, with the bilinear kernel's value."""
    _, h, w = size
    column, row = torch.floor(u - 0.5), torch.floor(v - 0.5)
    right, down = u - 0.5 - column, v - 0.5 - row
    pixels, points, kernels = [], [], []
    for x, kernel_x in ((column, 1 - right), (column + 1, right)):
        for y, kernel_y in ((row, 1 - down), (row + 1, down)):
            kernel = kernel_x * kernel_y
            inside = (x >= 0) & (x < w) & (y >= 0) & (y < h) & (kernel >= LEAST_KERNEL)
            point = inside.nonzero()[:, 0]
            pixels.append((image[point] * h + y[point].long()) * w + x[point].long())
            points.append(point)
            kernels.append(kernel[point])
    return torch.cat(pixels), torch.cat(points), torch.cat(kernels)
