"""The warped image: what the references show of the query view (paper II-A).

Depth maps become surfaces (`normals`), surfaces become points as dense as the query sees them
(`warp_points`, projected by `warp_projection`), less those behind space that a reference never saw
(`warp_walls`), and the points are drawn with weights by depth (`splat`). Each step is there twice:
in torch, for GPUs and gradients, and under the same name with `_numba`, in loops for the CPU. The
torch files explain the method and own its constants; both give the same picture within rounding.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from extrap_train.geometry.splat import needs_torch
from extrap_train.geometry.splat_numba import splat_numba
from extrap_train.geometry.splat_torch import splat_torch
from extrap_train.geometry.warp_flow import move_points_numba, moved_points
from extrap_train.geometry.warp_points import sample_surfaces
from extrap_train.geometry.warp_points_numba import sample_surfaces_numba
from extrap_train.views import Camera, Warp

NEAREST_SHARE = 0.02
"""Least share of a pixel's weight for which the nearest reference is said to reach it."""


def warp_references(
    images: Float[Tensor, "b k 3 h w"],
    depths: Float[Tensor, "b k h w"],
    cameras: Camera,
    valid: Bool[Tensor, "b k"],
    query: Camera,
    flows: Float[Tensor, "b k 2 g g"] | None = None,
) -> Warp:
    """Fuse all references of each query view in one depth-aware splat; reference 0 is the nearest.

    `cameras` is batched `b k` and `query` `b`; the query's image size may differ from the
    references'. Depth 0 (or not finite) is unknown, and `valid` False leaves a reference out.
    `flows` moves each reference's points in the query image before they are drawn (`geometry.flow`,
    METHOD §6): colours, coordinates, depth and mask go together, and nothing is resampled twice.
    """
    depths = torch.where(valid[..., None, None], depths, 0)
    if needs_torch(images, depths):
        samples = sample_surfaces(images, depths, cameras, query)
        points = samples.points
        if flows is not None:
            points = moved_points(points, samples.reference, flows, query)
        means = splat_torch(points, samples.values, (len(images), query.height, query.width))
    else:
        drawn = sample_surfaces_numba(images, depths, cameras, query)
        if flows is not None:
            move_points_numba(drawn[0], drawn[3], flows, query)
        means = splat_numba(*drawn, query.height, query.width)
    weight = means[:, 7]
    share = means[:, 5]
    nearest_mask = (share >= NEAREST_SHARE).to(images.dtype)
    coordinates = means[:, 3:5] / torch.where(nearest_mask > 0, share, 1)[:, None]
    return Warp(
        image=means[:, :3],
        coordinates=coordinates * nearest_mask[:, None],
        depth=means[:, 6],
        weight=weight,
        mask=(weight > 0).to(images.dtype),
        nearest_mask=nearest_mask,
    )
