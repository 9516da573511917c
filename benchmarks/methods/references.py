"""Inputs by nearness to a target, and with their depth: what every warping method needs."""

from dataclasses import replace

from benchmarks.methods.base import SceneInputs
from extrap_train.geometry.viewpoints import references_by_nearness
from extrap_train.views import View, stack_cameras


def nearest_inputs(inputs: SceneInputs, count: int) -> list[list[int]]:
    """For every target the up to `count` nearest inputs, nearest first (METHOD §1)."""
    cameras = stack_cameras([view.camera for view in inputs.views])
    order: list[list[int]] = references_by_nearness(cameras, inputs.targets)[:, :count].tolist()
    return order


def views_with_depth(inputs: SceneInputs) -> list[View]:
    """The inputs at their finer size with depth from the given source, 0 where it is unsure."""
    found = inputs.depth_source.depth_maps(inputs.fine_views)
    return [
        replace(view, depth=depth.reliable())
        for view, depth in zip(inputs.fine_views, found, strict=True)
    ]
