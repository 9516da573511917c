"""Which depths a view can have, from the cameras alone."""

import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.depth.photo_cost import projection_between
from extrap_train.geometry.viewpoints import scene_center
from extrap_train.views import Camera, stack_poses

NEAREST, FARTHEST = 0.3, 20.0
"""Range of depths, as multiples of the scene centre's depth."""
WIDEST_DISPARITY = 0.25
"""Of cameras that look the same way: largest displacement, as a share of the longer side."""
LEAST_BASELINE = 1e-6
"""In scene units: cameras that are nearer to each other stand in one place."""
LEAST_SEEN = 0.1
"""A depth is not tried if a smaller share of the pixels is then seen by any neighbour."""
LEAST_CONVERGENCE_RAD = 0.05
"""Optical axes that differ by less have no nearest point worth the name."""


def convergence_point(cameras: list[Camera]) -> Float[Tensor, "3"] | None:
    """`scene_center` of cameras whose optical axes meet; None if they are nearly parallel."""
    poses = stack_poses(cameras)
    axes = poses.forward.double()
    if float(torch.acos((axes @ axes.mT).clamp(-1, 1)).max()) < LEAST_CONVERGENCE_RAD:
        return None
    return torch.from_numpy(scene_center(poses)).to(poses.world_to_cam)


def inverse_depth_range(
    camera: Camera, neighbours: list[Camera], center: Float[Tensor, "3"] | None
) -> tuple[float, float]:
    """Least and greatest inverse depth that a pixel of `camera` may have, in 1 / scene unit.

    Around the scene's centre; for cameras that look the same way, or away from it, from infinity
    to where the displacement between the images becomes too large. Depths that no neighbour sees
    are cut off, but never so many that the range is empty.
    """
    center_depth = 0.0
    if center is not None:
        center_depth = float(camera.world_to_cam[2, :3] @ center + camera.world_to_cam[2, 3])
    if center_depth > 0:
        least, greatest = 1 / (FARTHEST * center_depth), 1 / (NEAREST * center_depth)
    else:
        baseline = max(float((other.center - camera.center).norm()) for other in neighbours)
        longer = max(camera.height, camera.width)
        pixels_at_one = float(camera.intrinsics[0, 0]) * max(baseline, LEAST_BASELINE)
        greatest = WIDEST_DISPARITY * longer / pixels_at_one
        least = greatest / 100
    return _visible_range(camera, neighbours, torch.linspace(least, greatest, 200))


def _visible_range(
    camera: Camera, neighbours: list[Camera], candidates: Float[Tensor, " d"]
) -> tuple[float, float]:
    small = camera.resized(16, 16)
    inverse_depth = candidates.to(camera.intrinsics)[:, None, None].expand(-1, 16, 16)
    seen = [
        projection_between(small, other).normalised_points(inverse_depth)[1] for other in neighbours
    ]
    share = torch.stack(seen).any(0).float().mean((-2, -1))
    used = (share.cpu() >= LEAST_SEEN).nonzero().flatten().tolist()
    if not used:
        return float(candidates[0]), float(candidates[-1])
    if len(used) == 1:  # the true depth lies around it
        used = [max(used[0] - 1, 0), min(used[0] + 1, len(candidates) - 1)]
    return float(candidates[used[0]]), float(candidates[used[-1]])
