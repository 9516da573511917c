"""The warped image: what the references show of the query view (paper II-A)."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from extrap_train.geometry.encoding import coordinate_grid
from extrap_train.geometry.splat import splat_pixels
from extrap_train.geometry.splat_samples import sample_surfaces
from extrap_train.views import Camera, Warp

NEAREST_SHARE = 0.02
"""Least share of a pixel's weight for which the nearest reference is said to reach it."""


def warp_references(
    images: Float[Tensor, "b k 3 h w"],
    depths: Float[Tensor, "b k h w"],
    cameras: Camera,
    valid: Bool[Tensor, "b k"],
    query: Camera,
) -> Warp:
    """Fuse all references of each query view in one depth-aware splat; reference 0 is the nearest.

    `cameras` is batched `b k` and `query` `b`; the query's image size may differ from the
    references'. Depth 0 (or not finite) is unknown, and `valid` False leaves a reference out.
    """
    b, k, _, h, w = images.shape
    depths = torch.where(valid[..., None, None], depths, 0)
    grid = coordinate_grid(h, w, images.device).to(images.dtype)
    nearest = torch.zeros(b, k, 1, h, w, device=images.device, dtype=images.dtype)
    nearest[:, 0] = 1
    maps = torch.cat([images, grid * nearest, nearest], 2)
    samples = sample_surfaces(depths, maps, cameras, query)
    values = torch.cat([samples.values, samples.points.depth[:, None]], 1)
    splat = splat_pixels(samples.points, values, b, query.height, query.width)
    means = splat.values
    share = means[:, 5]
    nearest_mask = (share >= NEAREST_SHARE).to(images.dtype)
    coordinates = means[:, 3:5] / torch.where(nearest_mask > 0, share, 1)[:, None]
    return Warp(
        image=means[:, :3],
        coordinates=coordinates * nearest_mask[:, None],
        depth=means[:, 6],
        weight=splat.weight,
        mask=(splat.weight > 0).to(images.dtype),
        nearest_mask=nearest_mask,
    )
