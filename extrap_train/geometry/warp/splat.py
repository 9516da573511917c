"""Softmax splatting of points by depth (paper Eq. 1), in torch: on any device, differentiable in
positions, depth and values.

Per pixel, `Σ b·e·v / Σ b·e` with the bilinear kernel b and `e = exp(−β |z/z_nearest − 1|)`, where
z_nearest is the least depth of the points that reach the pixel's centre: it is the maximum that is
subtracted and the unit that depth is measured in, so nothing overflows and nothing depends on the
scene's scale. A point that touches the kernel but does not reach the centre blends in without
making the silhouette grow; a pixel that no point reaches stays empty.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

DEPTH_SHARPNESS = 200.0
"""β: a surface 5 % behind the nearest one weighs e⁻¹⁰, so it does not bleed through."""

OUTSIDE = -10.0
"""Pixel coordinate of points that are not to be drawn."""


@dataclass(frozen=True)
class ScreenPoints:
    """Points projected into images of one size."""

    u: Float[Tensor, " n"]
    v: Float[Tensor, " n"]
    depth: Float[Tensor, " n"]
    """Positive."""
    reach_u: Float[Tensor, " n"]
    """Half the width, in pixels up to 1, of the piece of surface that the point stands for."""
    reach_v: Float[Tensor, " n"]
    image: Int[Tensor, " n"]
    """Which of the images a point is drawn into, in ascending order."""

    def __getitem__(self, chosen: Int[Tensor, " m"]) -> "ScreenPoints":
        """The points with these indices."""
        return replace(self, **{name: column[chosen] for name, column in vars(self).items()})


def splat_torch(
    points: ScreenPoints, values: Float[Tensor, "n c"], size: tuple[int, int, int]
) -> Float[Tensor, "b c1 h w"]:
    """Weighted means of the values, and the summed weight as the last channel, for `size` = (b, h,
    w)."""
    pixel, point, kernel, reached = _footprints(points, size)
    b, h, w = size
    z = points.depth[point]
    nearest = torch.full((b * h * w,), torch.inf, device=z.device, dtype=z.dtype)
    claim = torch.where(reached, z, torch.inf)
    nearest = nearest.scatter_reduce(0, pixel, claim, "amin")[pixel]
    claimed = torch.isfinite(nearest)
    unit = torch.where(claimed, nearest, 1)
    away = torch.where(claimed, (z - unit).abs() / unit, torch.inf)
    weight = kernel * torch.exp(-DEPTH_SHARPNESS * away)
    rows = torch.cat([values[point] * weight[:, None], weight[:, None]], 1)
    summed = torch.zeros(b * h * w, rows.shape[1], device=rows.device, dtype=rows.dtype)
    summed = summed.index_add(0, pixel, rows).reshape(b, h, w, -1).movedim(-1, 1)
    total = summed[:, -1:]
    return torch.cat([summed[:, :-1] / torch.where(total > 0, total, 1), total], 1)


def _footprints(
    points: ScreenPoints, size: tuple[int, int, int]
) -> tuple[Int[Tensor, " m"], Int[Tensor, " m"], Float[Tensor, " m"], Bool[Tensor, " m"]]:
    """Pairs of a pixel (flat index) and a point near it, their kernel, and whether the point
    reaches its centre."""
    _, h, w = size
    column, row = torch.floor(points.u - 0.5), torch.floor(points.v - 0.5)
    right, down = points.u - 0.5 - column, points.v - 0.5 - row
    pairs = []
    for x, apart_x in ((column, right), (column + 1, 1 - right)):
        for y, apart_y in ((row, down), (row + 1, 1 - down)):
            kernel = (1 - apart_x) * (1 - apart_y)
            inside = (x >= 0) & (x < w) & (y >= 0) & (y < h) & (kernel > 0)
            point = inside.nonzero()[:, 0]
            pixel = (points.image[point] * h + y[point].long()) * w + x[point].long()
            reached = (apart_x <= points.reach_u) & (apart_y <= points.reach_v)
            pairs.append((pixel, point, kernel[point], reached[point]))
    pixels, indices, kernels, reaches = zip(*pairs, strict=True)
    return torch.cat(pixels), torch.cat(indices), torch.cat(kernels), torch.cat(reaches)
