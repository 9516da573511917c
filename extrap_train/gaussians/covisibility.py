"""Which pixels show what a better view already shows (InstantSplat, section 3.2)."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from extrap_train.depth import DepthMap
from extrap_train.geometry.cameras import project, unproject_to_world
from extrap_train.views import Camera, View


def unique_pixels(
    views: Sequence[View], maps: Sequence[DepthMap], threshold: float
) -> list[Bool[Tensor, "h w"]]:
    """For each view the pixels that no view of higher mean confidence has given a point for.

    A pixel is redundant where the points of the better views, projected into it, have its depth
    within `threshold` of the view's own range of depths.
    """
    confidences = [float(each.confidence.mean()) for each in maps]
    order = sorted(range(len(views)), key=lambda i: (-confidences[i], i))
    unique: list[Bool[Tensor, "h w"]] = [each.reliable() > 0 for each in maps]
    given = torch.zeros(0, 3)
    for index in order:
        camera, depth = views[index].camera, maps[index].depth
        known = unique[index]
        if known.any() and len(given):
            span = depth[known].max() - depth[known].min()
            there = nearest_depth(given, camera)
            same = (there > 0) & ((there - depth).abs() < threshold * span)
            unique[index] = known & ~same
        given = torch.cat([given, unproject_to_world(depth, camera)[unique[index]]])
    return unique


def nearest_depth(points: Float[Tensor, "n 3"], camera: Camera) -> Float[Tensor, "h w"]:
    """Depth of the nearest point in each pixel; 0 where there is none."""
    pixels, depth = project(points, camera)
    column, row = pixels.floor().long().unbind(-1)
    inside = (depth > 0) & (column >= 0) & (column < camera.width)
    inside = inside & (row >= 0) & (row < camera.height)
    place = (row * camera.width + column)[inside]
    nearest = torch.full((camera.height * camera.width,), torch.inf)
    nearest = nearest.scatter_reduce(0, place, depth[inside], "amin")
    return torch.where(nearest.isfinite(), nearest, 0).reshape(camera.height, camera.width)
