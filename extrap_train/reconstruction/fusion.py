"""The depth that all views agree on, once every view is there.

Each generated view was given its depth when it came, from what was known then, and errs in its own
way. Here its surface moves along its rays to where the views' truncated signed distances cancel
(Curless and Levoy, A Volumetric Method for Building Complex Models from Range Images, 1996),
sampled along the rays of the views instead of on a grid.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.geometry.cameras import project, unproject_to_world
from extrap_train.reconstruction.global_map import GIVEN, MAX_COMPARED, GlobalMap, MapView
from extrap_train.views import stack_cameras

_TRUNCATION = 0.02
"""Relative difference of depth up to which two views may show the same surface."""
_REACH = 3 * _TRUNCATION
"""How far a surface may move along its rays, relative to its depth."""
_SAMPLES = 25


def fuse_depths(scene_map: GlobalMap) -> GlobalMap:
    """The map with the generated views' depths fused; what the photographs show stays.

    A surface that the others contradict, so that no place for it is left within reach of its own,
    loses its confidence.
    """
    fused = GlobalMap(scene_map.tolerance)
    for view in scene_map.views:
        depth, confidence = view.depth, view.confidence
        if view.origin.kind != GIVEN:
            depth, confidence = _fuse(view, scene_map)
        fused, _ = fused.added(replace(view.view, depth=depth), confidence, view.origin)
    return fused


def _fuse(view: MapView, scene_map: GlobalMap) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
    """One view's depth, and its confidence: 0 where no surface is left."""
    shifts = torch.linspace(-_REACH, _REACH, _SAMPLES, dtype=view.depth.dtype)
    depths = view.depth * (1 + shifts[:, None, None])
    points = unproject_to_world(depths, stack_cameras([view.camera] * _SAMPLES)).flatten(0, 2)
    total, weights = torch.zeros_like(points[:, 0]), torch.zeros_like(points[:, 0])
    for index in scene_map.nearest(view.camera, MAX_COMPARED):  # itself the first of them
        distance, weight = signed_distance(points, scene_map.views[index], _TRUNCATION)
        total += weight * distance
        weights += weight
    # 0 where no view weighs, so that free space that ends there ends in a surface: without that, as
    # many true surfaces at grazing edges would be lost as false ones.
    mean = (total / weights.clamp(min=1e-30)).view_as(depths)
    shift = _nearest_zero(mean, shifts)
    found = shift.isfinite()
    depth = torch.where(found, view.depth * (1 + shift), view.depth)
    return depth, torch.where(found, view.confidence, 0)


def signed_distance(
    points: Float[Tensor, "n 3"], view: MapView, truncation: float
) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
    """How far each point lies in front of the view's surface, in truncations and at most 1; and its
    weight, the view's confidence: 0 beyond one truncation behind the surface, which hides the rest.
    """
    pixels, z = project(points, view.camera)
    column, row = pixels.floor().long().unbind(-1)
    height, width = view.depth.shape
    inside = (z > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    index = torch.where(inside, row * width + column, 0)
    surface, confidence = view.depth.flatten()[index], view.confidence.flatten()[index]
    distance = (surface / z.clamp(min=1e-30) - 1) / truncation
    seen = inside & (surface > 0) & (distance > -1)
    return distance.clamp(max=1), torch.where(seen, confidence, 0)


def _nearest_zero(
    values: Float[Tensor, "s h w"], places: Float[Tensor, " s"]
) -> Float[Tensor, "h w"]:
    """Where the values fall through zero, the place nearest to 0; infinite where they never do."""
    before, after = values[:-1], values[1:]
    share = before / (before - after).clamp(min=1e-30)
    zeros = places[:-1, None, None] + share * (places[1] - places[0])
    zeros = torch.where((before > 0) & (after <= 0), zeros, torch.inf)
    nearest = zeros.abs().argmin(0, keepdim=True)
    return zeros.gather(0, nearest)[0]
