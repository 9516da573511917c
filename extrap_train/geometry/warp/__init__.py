"""The warped image: what the references show of the query view (paper II-A, Eq. 1).

A pixel is a hole if no point reaches its centre (`splat`). Points are never made on back faces or
at depth jumps (`sample`, `surface`), and are dropped behind unseen space (`occlusion`).

`warp_references` is the whole of it. Each step is there twice: in torch, for GPUs and gradients,
and as compiled loops for the CPU, in the file whose name ends in `_numba`. The torch files explain
the method and own its constants; both give the same picture within rounding, and the loops give the
same bits for any number of threads.
"""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from extrap_train.geometry.resample import reduce_batch
from extrap_train.geometry.warp.sample import move_points, sample_surfaces
from extrap_train.geometry.warp.sample_numba import move_points_numba, sample_surfaces_numba
from extrap_train.geometry.warp.splat import OUTSIDE, ScreenPoints, splat_torch
from extrap_train.geometry.warp.splat_numba import project_numba, splat_numba
from extrap_train.views import Camera, PairBatch, Warp

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
    `flows` (`geometry.spline_flow`) moves each reference's points in the query image before they
    are drawn: colours, coordinates, depth and mask move together, and nothing is resampled twice.
    """
    depths = torch.where(valid[..., None, None], depths, 0)
    draw = draw_torch if needs_torch(images, depths) else _draw_numba
    return warp_of_means(draw(images, depths, cameras, query, flows))


def warp_of_means(means: Float[Tensor, "b 8 h w"]) -> Warp:
    """The warp that `draw_torch` has drawn."""
    # Channels: colour 0–2, coordinates 3–4, share of the nearest reference 5, depth 6, weight 7.
    share, weight = means[:, 5], means[:, 7]
    nearest_mask = (share >= NEAREST_SHARE).to(means.dtype)
    coordinates = means[:, 3:5] / torch.where(nearest_mask > 0, share, 1)[:, None]
    return Warp(
        image=means[:, :3],
        coordinates=coordinates * nearest_mask[:, None],
        depth=means[:, 6],
        weight=weight,
        mask=(weight > 0).to(means.dtype),
        nearest_mask=nearest_mask,
    )


def draw_torch(
    images: Float[Tensor, "b k 3 h w"],
    depths: Float[Tensor, "b k h w"],
    cameras: Camera,
    query: Camera,
    flows: Float[Tensor, "b k 2 g g"] | None,
) -> Float[Tensor, "b 8 h2 w2"]:
    """The channels of `warp_of_means`, in torch."""
    # Unproject, cull what faces away or lies behind unseen space, project: points as dense as
    # the query sees them.
    samples = sample_surfaces(images, depths, cameras, query)
    points = samples.points
    if flows is not None:
        points = move_points(points, samples.reference, flows, query)
    # Eq. 1: one splat by depth of colours, coordinates and depth of all references.
    return splat_torch(points, samples.values, (len(images), query.height, query.width))


def _draw_numba(
    images: Float[Tensor, "b k 3 h w"],
    depths: Float[Tensor, "b k h w"],
    cameras: Camera,
    query: Camera,
    flows: Float[Tensor, "b k 2 g g"] | None,
) -> Float[Tensor, "b 8 h2 w2"]:
    drawn = sample_surfaces_numba(images, depths, cameras, query)
    if flows is not None:
        move_points_numba(drawn[0], drawn[3], flows, query)
    return splat_numba(*drawn, query.height, query.width)


def compute_warp(batch: PairBatch, image_size: int | None = None) -> PairBatch:
    """The batch with its warp, made on the device where the batch lies.

    The warp is made at the batch's own size; then everything is reduced to `image_size`, of which
    that size is a multiple. None keeps it.
    """
    if batch.warp is not None:
        if image_size not in (None, batch.camera.height):
            raise ValueError(f"the warp is there already, at {batch.camera.height} pixels")
        return batch
    warp = warp_references(
        batch.reference_images,
        batch.reference_depths,
        batch.reference_cameras,
        batch.reference_valid,
        batch.camera,
        batch.reference_flows,
    )
    factor, rest = divmod(batch.camera.height, image_size or batch.camera.height)
    if rest or not factor:
        raise ValueError(f"{batch.camera.height} pixels are not a multiple of {image_size}")
    return reduce_batch(replace(batch, warp=warp), factor)


def splat_points(
    world_points: Float[Tensor, "n 3"], values: Float[Tensor, "n c"], camera: Camera
) -> Float[Tensor, "c1 h w"]:
    """Draw a cloud of points as one (unbatched) camera sees it, each a bilinear dot.

    Means of the values, and as the last channel the weight Σ b·e, bilinear coverage by the nearest
    surface; zero where nothing landed.
    """
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
    return means[0]


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
    return differentiated or any(x.device.type != "cpu" or x.dtype != torch.float32 for x in inputs)
