"""Which other views help to find a view's depth."""

import math
from collections.abc import Sequence
from itertools import cycle

import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.depth.depth_range import convergence_point
from extrap_train.views import Camera, View

NEAREST_RAD, FARTHEST_RAD = math.radians(6), math.radians(18)
"""Seen from the scene's centre: nearer and depth is vague, farther and surfaces look different."""
LEAST_RAD, LIMIT_RAD = math.radians(3), math.radians(45)
"""Outside, views never help in stereo: those of the same place agree at any depth."""
ROUNDING = 2e-6
"""Of the cameras' distance from the origin: what rounding alone makes of one place."""

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
    useful = (angle_rad >= LEAST_RAD) & (angle_rad <= limit_rad)
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
