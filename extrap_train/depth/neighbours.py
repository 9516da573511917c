"""Which other views help to find a view's depth, and which depths it can have."""

import math
from collections.abc import Sequence
from itertools import cycle

import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.depth.photo_cost import projection_between
from extrap_train.geometry.viewpoints import scene_center
from extrap_train.views import Camera, View, stack_poses

NEAREST_RAD, FARTHEST_RAD = math.radians(6), math.radians(18)
"""Seen from the scene's centre: nearer and depth is vague, farther and surfaces look different."""
MIN_RAD, LIMIT_RAD = math.radians(3), math.radians(45)
"""Outside, views never help in stereo: those of the same place agree at any depth."""
ROUNDING = 2e-6
"""Distance, as a share of the cameras' distance from the origin, that rounding alone puts between
two cameras in one place."""

WIDEST_RAD = math.radians(90)
"""Limit of what matchers and learned point maps bridge."""


def neighbours_of(
    views: Sequence[View], count: int, limit_rad: float = LIMIT_RAD
) -> list[list[int]]:
    """`choose_neighbours` of views that look at the point where their axes converge."""
    cameras = [view.camera for view in views]
    return choose_neighbours(cameras, convergence_point(cameras), count, limit_rad)


def choose_neighbours(
    cameras: list[Camera],
    center: Float[Tensor, "3"] | None,
    count: int,
    limit_rad: float = LIMIT_RAD,
) -> list[list[int]]:
    """For every camera the indices of up to `count` others, alternating between left and right.

    Angles are those at `center`, up to `limit_rad`; without one (cameras that look the same way)
    the nearest cameras are taken.
    """
    positions = torch.stack([camera.center for camera in cameras])
    rights = torch.stack([camera.world_to_cam[0, :3] for camera in cameras])
    on_right = ((positions[None] - positions[:, None]) * rights[:, None]).sum(-1) > 0
    apart = _distances(positions)
    if center is None:
        badness = torch.where(apart > 0, apart, torch.inf)
    else:
        badness = _badness(_angles_rad(positions - center), limit_rad)
        badness = torch.where(apart > 0, badness, torch.inf)
    return [_by_turns(badness[i], on_right[i], count) for i in range(len(cameras))]


def nearest_angle_rad(views: Sequence[View]) -> float | None:
    """The smallest angle between two views, as seen from the point where their axes converge.

    0 where all stand in one place; None for a single view, or axes that converge nowhere.
    """
    cameras = [view.camera for view in views]
    positions = torch.stack([camera.center for camera in cameras])
    center = convergence_point(cameras)
    if len(views) < 2 or center is None:
        return None
    if not (_distances(positions) > 0).any():
        return 0.0
    return float(_angles_rad(positions - center).min())


def _distances(positions: Float[Tensor, "n 3"]) -> Float[Tensor, "n n"]:
    """Between every two positions; 0 where only rounding tells them apart."""
    # From differences: products, which `cdist` takes for many, drown them far from the origin.
    distances = torch.cdist(positions, positions, compute_mode="donot_use_mm_for_euclid_dist")
    rounding = ROUNDING * positions.norm(dim=-1).max()
    return torch.where(distances > rounding, distances, 0)


def _angles_rad(offsets: Float[Tensor, "n 3"]) -> Float[Tensor, "n n"]:
    """Between every two of them; infinite on the diagonal, and from a zero one, which has none."""
    distance = offsets.norm(dim=-1, keepdim=True)
    directions = offsets / distance.clamp_min(torch.finfo(offsets.dtype).tiny)
    angle_rad = torch.acos((directions @ directions.mT).clamp(-1, 1)).fill_diagonal_(torch.inf)
    apart = (distance > 0) & (distance > 0).mT
    return torch.where(apart, angle_rad, torch.inf)


def _badness(angle_rad: Float[Tensor, "n n"], limit_rad: float) -> Float[Tensor, "n n"]:
    """How far an angle is from the useful range, then from its middle; infinite if useless."""
    outside = (NEAREST_RAD - angle_rad).clamp_min(0) + (angle_rad - FARTHEST_RAD).clamp_min(0)
    useful = (angle_rad >= MIN_RAD) & (angle_rad <= limit_rad)
    middle = (angle_rad - (NEAREST_RAD + FARTHEST_RAD) / 2).abs()
    return torch.where(useful, 10 * outside + middle, torch.inf)


def _by_turns(badness: Float[Tensor, " n"], on_right: Tensor, count: int) -> list[int]:
    order = [i for i in badness.argsort().tolist() if math.isfinite(badness[i])]
    sides = [[i for i in order if bool(on_right[i]) is right] for right in (False, True)]
    if order and order[0] in sides[1]:
        sides.reverse()
    chosen: list[int] = []
    for side in cycle(sides):
        if len(chosen) == min(count, len(order)):
            return chosen
        if side:
            chosen.append(side.pop(0))
    return chosen


NEAREST, FARTHEST = 0.3, 20.0
"""Range of depths, as multiples of the scene centre's depth."""
WIDEST_DISPARITY = 0.25
"""Largest displacement between cameras that look the same way, as a share of the longer side."""
MIN_BASELINE = 1e-6
"""In scene units: cameras that are nearer to each other stand in one place."""
MIN_SEEN = 0.1
"""A depth is not tried if a smaller share of the pixels is then seen by any neighbour."""
MIN_CONVERGENCE_RAD = 0.05
"""Optical axes that differ by less have no nearest point worth the name."""


def convergence_point(cameras: list[Camera]) -> Float[Tensor, "3"] | None:
    """`scene_center` of cameras whose optical axes meet; None if they are nearly parallel."""
    poses = stack_poses(cameras)
    axes = poses.forward.double()
    if float(torch.acos((axes @ axes.mT).clamp(-1, 1)).max()) < MIN_CONVERGENCE_RAD:
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
        pixels_at_one = float(camera.intrinsics[0, 0]) * max(baseline, MIN_BASELINE)
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
    used = (share.cpu() >= MIN_SEEN).nonzero().flatten().tolist()
    if not used:
        return float(candidates[0]), float(candidates[-1])
    if len(used) == 1:  # the true depth lies around it
        used = [max(used[0] - 1, 0), min(used[0] + 1, len(candidates) - 1)]
    return float(candidates[used[0]]), float(candidates[used[-1]])
