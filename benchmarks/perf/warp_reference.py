"""Softmax splatting as one writes it in plain vectorised torch: four corners, `index_add_`."""

import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.geometry.warp.splat import DEPTH_SHARPNESS
from extrap_train.views import Camera


def splat_reference(
    world_points: Float[Tensor, "n 3"], values: Float[Tensor, "n c"], camera: Camera
) -> Float[Tensor, "h w c1"]:
    """Mean values and, as the last channel, the summed weight (see `geometry.warp.splat`)."""
    x, y, z = world_points.unbind(-1)
    rows = camera.intrinsics @ camera.world_to_cam[:3]
    u, v, depth = (row[0] * x + row[1] * y + row[2] * z + row[3] for row in rows)
    u, v = u / depth - 0.5, v / depth - 0.5
    left, top = u.floor(), v.floor()
    h, w = camera.height, camera.width
    corners = []
    for dx in (0, 1):
        for dy in (0, 1):
            column, row = left + dx, top + dy
            kernel = (1 - (u - column).abs()) * (1 - (v - row).abs())
            inside = (
                (depth > 0) & (column >= 0) & (column < w) & (row >= 0) & (row < h) & (kernel > 0)
            )
            pixel = torch.where(inside, row * w + column, h * w).long()
            corners.append((pixel, torch.where(inside, kernel, 0)))
    nearest = torch.full((h * w + 1,), torch.inf, device=z.device)
    for pixel, _ in corners:
        nearest.scatter_reduce_(0, pixel, depth, "amin")
    total = torch.zeros(h * w + 1, values.shape[1] + 1, device=z.device)
    weighted = torch.cat([values, torch.ones_like(values[:, :1])], 1)
    for pixel, kernel in corners:
        near = nearest[pixel]
        weight = kernel * torch.exp(-DEPTH_SHARPNESS * (depth - near) / near)
        total.index_add_(0, pixel, weighted * weight[:, None])
    total = total[:-1].reshape(h, w, -1)
    weight = total[..., -1:]
    return torch.cat([total[..., :-1] / torch.where(weight > 0, weight, 1), weight], -1)
