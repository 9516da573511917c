"""References that nobody took: each of a scene's inputs as it looks from beside itself."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from extrap_train.data.module import compute_warp
from extrap_train.data.queries import query_batch
from extrap_train.geometry.fill import fill_holes
from extrap_train.geometry.orbits import turn_camera
from extrap_train.geometry.viewpoints import camera_centers, common_center
from extrap_train.views import View, stack_cameras

_NEAREST_RAD, _FARTHEST_RAD = np.deg2rad([10, 60])
"""Angles that a reference stands beside its query at: about those that are asked for later."""


@dataclass(frozen=True)
class VirtualReference:
    """A view that stands beside one of the inputs, the query that it is a reference of."""

    view: View
    """Warped from its query. Depth is 0 where that does not reach; the image is filled there."""
    query: int
    angle_rad: float


def virtual_references(views: Sequence[View], count: int, seed: int) -> list[VirtualReference]:
    """`count` references beside each of the views (square, all of one size, with depth).

    They are turned about the scene's vertical by angles that are drawn evenly between 10 and 60
    degrees, to both sides in turn, and see what their own view sees. The other views are left out:
    where exposures differ, or depth is estimated, they teach to blur. Deterministic in the seed.
    """
    pivots, axis = _pivots(views), _vertical(views)
    rng = np.random.default_rng(seed)
    made: list[VirtualReference] = []
    for query, view in enumerate(views):
        shares = (np.arange(count) + rng.uniform(size=count)) / count
        angles = _NEAREST_RAD + (_FARTHEST_RAD - _NEAREST_RAD) * shares
        sides = np.where(np.arange(count) % 2, 1.0, -1.0)
        cameras = turn_camera(view.camera, pivots[query], axis, angles * sides)
        batch, _ = query_batch([view], cameras, 1, view.camera.height)
        warp = compute_warp(batch).warp
        assert warp is not None
        images = fill_holes(warp.image, warp.mask).clamp(0, 1)
        made += [
            VirtualReference(View(images[i], cameras[i], warp.depth[i]), query, float(angles[i]))
            for i in range(count)
        ]
    return made


def _pivots(views: Sequence[View]) -> list[Float[np.ndarray, "3"]]:
    """What each view is turned about: the scene's centre; where they have none in common, the
    point in the middle of its image at its median depth.
    """
    cameras = stack_cameras([view.camera for view in views])
    center = common_center(cameras)
    if center is not None:
        return [center] * len(views)
    forward = cameras.forward.double().numpy(force=True)
    depths = np.array([_median_depth(view) for view in views])
    return list(camera_centers(cameras) + depths[:, None] * forward)


def _median_depth(view: View) -> float:
    assert view.depth is not None
    known = view.depth[view.depth > 0]
    return float(known.median()) if len(known) else 1.0


def _vertical(views: Sequence[View]) -> Float[np.ndarray, "3"]:
    """Where the images' up points on average; two cameras do not say more of their orbit."""
    cameras = stack_cameras([view.camera for view in views])
    up = -cameras.world_to_cam[:, 1, :3].double().numpy(force=True).mean(0)
    length = np.linalg.norm(up)
    return up / length if length > 0 else np.array([0.0, -1.0, 0.0])
