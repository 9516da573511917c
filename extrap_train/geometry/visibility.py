"""Visibility through unobserved space: which part of a query's rays no reference has looked into.

A warped point is known to be visible only if the ray towards it runs through space that some
reference has *seen to be empty*. A point of space is observed empty if a reference
has a known depth where the point projects, and the point lies in front of it by more than
`TOLERANCE`. All other space is unobserved: it lies behind a surface, or outside every reference's
view. It may be empty or not; a surface that is warped from behind it is a hypothesis.

Rays are sampled at `SAMPLES` depths within a ball around the scene, because far from the scene all
space is unobserved and nothing is there. The kernel for the CPU is `visibility_numba`; both give
the same up to rounding.
"""

import math
from dataclasses import dataclass, fields

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from extrap_train.geometry.cameras import pixel_grid
from extrap_train.geometry.viewpoints import camera_centers, scene_center
from extrap_train.geometry.visibility_numba import trace_numba
from extrap_train.geometry.warp import needs_torch
from extrap_train.views import Camera

SAMPLES = 64
"""Depths at which a ray is looked at between its entry into the ball and its exit."""
BISECTIONS = 3
"""Halvings of the step in which a ray first enters unobserved space."""
TOLERANCE = 0.01
"""Share of a reference's depth by which a point must lie in front of it to be in empty space."""
RADIUS_PER_DISTANCE = 0.5
"""Radius of the ball in cameras' distances to the scene's centre: CO3D's cameras hold an object in
view that is about as large as half their distance to it."""


@dataclass(frozen=True)
class Ball:
    """The part of space in which rays are followed, one per query."""

    center: Float[Tensor, "b 3"]
    """In the world."""
    radius: Float[Tensor, " b"]
    """In scene units."""

    @classmethod
    def around(cls, cameras: Camera) -> "Ball":
        """The scene that one set of cameras looks at, as a batch of one."""
        center = scene_center(cameras)
        distance = np.median(np.linalg.norm(camera_centers(cameras) - center, axis=1))
        return cls(
            torch.from_numpy(center)[None].to(cameras.world_to_cam),
            cameras.world_to_cam.new_tensor([RADIUS_PER_DISTANCE * distance]),
        )


@dataclass(frozen=True)
class Visibility:
    """What the references' depth maps leave open along each ray of a query."""

    entry: Float[Tensor, "b h w"]
    """Query depth at which the ray first enters unobserved space within the ball; infinite where it
    never does. On a surface that a reference sees it lies `TOLERANCE` in front of it."""
    unobserved: Float[Tensor, "b h w"]
    """Length of unobserved ray within the ball in front of the surface, in scene units."""


def trace_visibility(
    depths: Float[Tensor, "b k h w"],
    cameras: Camera,
    valid: Bool[Tensor, "b k"],
    query: Camera,
    surface: Float[Tensor, "b h2 w2"],
    ball: Ball,
) -> Visibility:
    """Follow every ray of each query through what its references saw to be empty.

    `cameras` is batched `b k` and `query` `b`. Depth 0 is unknown and shows nothing to be empty.
    `surface` is the query depth up to which unobserved space is counted, usually the warp's; where
    it is 0, the whole ray within the ball counts.
    """
    if needs_torch(depths, surface):
        return trace_torch(depths, cameras, valid, query, surface, ball)
    depths = torch.where(valid[..., None, None], depths, 0)
    rays = _Rays.through(cameras, query, ball)
    arrays = [getattr(rays, field.name).contiguous().numpy() for field in fields(rays)]
    entry, unobserved = torch.empty_like(surface), torch.empty_like(surface)
    trace_numba(
        depths.numpy(),
        *arrays,
        _limit(surface).numpy(),
        (SAMPLES, BISECTIONS, TOLERANCE),
        entry.numpy(),
        unobserved.numpy(),
    )
    return Visibility(entry, unobserved)


def _limit(surface: Float[Tensor, "b h w"]) -> Float[Tensor, "b h w"]:
    """The query depth up to which unobserved space is counted."""
    return torch.where(surface > 0, surface * (1 - TOLERANCE), torch.inf)


@dataclass(frozen=True)
class _Rays:
    """The queries' rays as the references see them: at query depth t, a ray lies at the homogeneous
    pixel `origin + t · (steps · (u, v, 1))` of a reference, whose last entry is the depth there."""

    origin: Float[Tensor, "b k 3"]
    steps: Float[Tensor, "b k 3 3"]
    start: Float[Tensor, "b h w"]
    """Query depth at which the ray enters the ball."""
    stop: Float[Tensor, "b h w"]
    """Query depth at which it leaves the ball; equal to `start` where it misses it."""
    stretch: Float[Tensor, "b h w"]
    """Length of ray per query depth."""

    @classmethod
    def through(cls, cameras: Camera, query: Camera, ball: Ball) -> "_Rays":
        """Through the pixel centres of the queries (batched `b`), for references batched `b k`."""
        directions = query.cam_to_world[:, :3, :3] @ torch.linalg.inv(query.intrinsics)
        pixels_from_world = cameras.intrinsics @ cameras.world_to_cam[..., :3, :]
        origin = pixels_from_world[..., :3] @ query.center[:, None, :, None]
        grid = pixel_grid(query.height, query.width, directions.device).to(directions.dtype)
        grid = torch.cat([grid, torch.ones_like(grid[..., :1])], -1)
        ray = torch.einsum("bij,hwj->bhwi", directions, grid)
        away = query.center - ball.center
        a = ray.square().sum(-1)
        half_b = torch.einsum("bhwi,bi->bhw", ray, away)
        c = (away.square().sum(-1) - ball.radius.square())[:, None, None]
        root = (half_b.square() - a * c).clamp(min=0).sqrt()
        start = ((-half_b - root) / a).clamp(min=0)
        stop = torch.maximum((-half_b + root) / a, start)
        return cls(
            origin=origin[..., 0] + pixels_from_world[..., 3],
            steps=pixels_from_world[..., :3] @ directions[:, None],
            start=start,
            stop=stop,
            stretch=a.sqrt(),
        )


def trace_torch(
    depths: Float[Tensor, "b k h w"],
    cameras: Camera,
    valid: Bool[Tensor, "b k"],
    query: Camera,
    surface: Float[Tensor, "b h2 w2"],
    ball: Ball,
) -> Visibility:
    """`trace_visibility` in torch, for GPUs: the definition, depth by depth, for all rays at
    once."""
    depths = torch.where(valid[..., None, None], depths, 0)
    rays, limit = _Rays.through(cameras, query, ball), _limit(surface)
    height, width = limit.shape[1:]
    grid = pixel_grid(height, width, limit.device).to(limit.dtype)
    grid = torch.cat([grid, torch.ones_like(grid[..., :1])], -1)
    along = torch.einsum("bkij,hwj->bkihw", rays.steps, grid)

    def is_empty(depth: Float[Tensor, "b h2 w2"]) -> Bool[Tensor, "b h2 w2"]:
        """Whether any reference has seen the rays' points at a query depth to be empty."""
        x, y, z = (rays.origin[..., None, None] + depth[:, None, None] * along).unbind(2)
        h, w = depths.shape[-2:]
        inside = (z > 0) & (x >= 0) & (y >= 0) & (x < w * z) & (y < h * z)
        safe = torch.where(inside, z, 1)
        column = torch.where(inside, x / safe, 0).long().clamp(max=w - 1)
        row = torch.where(inside, y / safe, 0).long().clamp(max=h - 1)
        seen = depths.flatten(2).gather(2, (row * w + column).flatten(2)).reshape(z.shape)
        return (inside & (seen > z * (1 + TOLERANCE))).any(1)

    step = (rays.stop - rays.start) / SAMPLES
    entry = torch.full_like(limit, math.inf)
    unobserved = torch.zeros_like(limit)
    for i in range(SAMPLES):
        depth = rays.start + (i + 0.5) * step
        is_open = ~is_empty(depth) & (step > 0)
        entry = torch.where(is_open & entry.isinf(), depth, entry)
        unobserved += torch.where(is_open & (depth < limit), step * rays.stretch, 0)
    found = torch.where(entry.isinf(), 0, entry)
    before = torch.maximum(found - step, rays.start)
    for _ in range(BISECTIONS):
        middle = (before + found) / 2
        empty = is_empty(middle)
        before, found = torch.where(empty, middle, before), torch.where(empty, found, middle)
    return Visibility(torch.where(entry.isinf(), torch.inf, (before + found) / 2), unobserved)
