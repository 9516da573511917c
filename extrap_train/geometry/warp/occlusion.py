"""Occlusion by what a reference cannot know: the space behind the edges of what it sees.

Seen from the side, a solid object has a flank that the reference never saw, and without it what
lies behind shines through. So a wall is drawn from each occluding edge backwards along the
reference's ray. The object's depth is unknown: `DEPTH_PER_WIDTH` suits an apple and a box.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from extrap_train.geometry.warp.query_projection import MIN_DEPTH_RATIO, project_pixels, subdivide
from extrap_train.geometry.warp.splat import ScreenPoints
from extrap_train.geometry.warp.surface import Surface
from extrap_train.views import Camera

DEPTH_PER_WIDTH = 0.35
"""Depth of the unseen part of an object as a share of its width: seen 45° from the side, the
flank of a cube stays closed and little of the surroundings is lost. The surface behind ends it in
any case."""
SPACING = 0.7
"""Query pixels between points of a wall, of which each fills the one pixel that it falls in."""
TOLERANCE = 0.01
"""Share of its depth by which a point must lie behind a wall to be hidden."""
MAX_WALL_POINTS = 256
"""Points of one wall from front to back."""
ACROSS = 3
"""Points of a wall along the edge, per reference pixel."""


def is_occluded(
    surface: Surface,
    matrix: Float[Tensor, "b k 3 4"],
    cameras: Camera,
    query: Camera,
    points: ScreenPoints,
    reference: Int[Tensor, " n"],
) -> Bool[Tensor, " n"]:
    """Which points lie behind space that their reference, one of b·k, never saw."""
    column = points.u.long().clamp(0, query.width - 1)
    row = points.v.long().clamp(0, query.height - 1)
    limits = occlusion_depth(surface, matrix, cameras, query).flatten(0, 1)
    limit = limits[reference, row, column]
    return points.depth > limit * (1 + TOLERANCE)


def occlusion_depth(
    surface: Surface, matrix: Float[Tensor, "b k 3 4"], cameras: Camera, query: Camera
) -> Float[Tensor, "b k h2 w2"]:
    """Per reference, the query depth where unseen space begins; infinite where the reference
    knows no better."""
    b, k = matrix.shape[:2]
    empty = torch.full((b * k * query.height * query.width,), torch.inf, device=matrix.device)
    image, side, v, u, start, stop = _occlusion_volumes(surface, cameras)
    walls = matrix.detach().reshape(-1, 3, 4)[image]
    length = _length(walls, u, v, start, stop)
    along = (length / SPACING).nan_to_num(0).clamp(1, MAX_WALL_POINTS).ceil().long()
    wall, offset = subdivide(torch.stack([along, torch.full_like(along, ACROSS)], -1))
    inverse = start[wall] + (stop - start)[wall] * (offset[:, 0] + 0.5)
    upright = side[wall] < 2
    x, y, ratio = project_pixels(
        walls[wall],
        u[wall] + torch.where(upright, 0, offset[:, 1]),
        v[wall] + torch.where(upright, offset[:, 1], 0),
        inverse,
    )
    column, row = torch.floor(x), torch.floor(y)
    inside = (column >= 0) & (column < query.width) & (row >= 0) & (row < query.height)
    drawn = (inside & (ratio > MIN_DEPTH_RATIO)).nonzero()[:, 0]
    pixel = (image[wall[drawn]] * query.height + row[drawn].long()) * query.width
    depth = (ratio / inverse)[drawn].to(empty.dtype)
    filled = empty.scatter_reduce(0, pixel + column[drawn].long(), depth, "amin")
    return filled.reshape(b, k, query.height, query.width)


def _occlusion_volumes(surface: Surface, cameras: Camera) -> tuple[Tensor, ...]:
    """Image, side, v, u of each occluding edge, and the inverse depths at which its wall starts
    and stops."""
    h, w = surface.inverse_depth.shape[-2:]
    inverse = surface.inverse_depth.detach().reshape(-1, h, w)
    ends = (surface.ends & surface.valid[..., None, :, :]).reshape(-1, 4, h, w)
    width = _widths(surface.connected.reshape(-1, 4, h, w))
    image, side, row, column = ends.nonzero().unbind(-1)
    sign = side % 2 * 2 - 1
    sideways = side < 2
    du, dv = torch.where(sideways, sign, 0), torch.where(sideways, 0, sign)
    start = inverse[image, row, column]
    focal = cameras.intrinsics.reshape(-1, 3, 3)[image]
    focal = torch.where(sideways, focal[:, 0, 0], focal[:, 1, 1])
    deepest = start / (1 + DEPTH_PER_WIDTH * width[image, side, row, column] / focal)
    stop = torch.maximum(deepest, inverse[image, row + dv, column + du])
    return image, side, row + 0.5 + dv / 2, column + 0.5 + du / 2, start, stop


def _widths(connected: Bool[Tensor, "n 4 h w"]) -> Int[Tensor, "n 4 h w"]:
    """Length in pixels of the surface that ends on each side, counted away from that side."""
    left, right, up, low = connected.unbind(1)
    to_left, to_right = _run(left), _run(right.flip(-1)).flip(-1)
    to_top, to_low = _run(up.mT).mT, _run(low.flip(-2).mT).mT.flip(-2)
    return torch.stack([to_right, to_left, to_low, to_top], 1)


def _run(connected: Bool[Tensor, "n h w"]) -> Int[Tensor, "n h w"]:
    """Pixels connected in a row up to each pixel along the last dimension, itself included."""
    position = torch.arange(connected.shape[-1], device=connected.device).expand(connected.shape)
    return position - torch.where(connected, 0, position).cummax(-1).values + 1


def _length(
    matrix: Float[Tensor, "n 3 4"],
    u: Float[Tensor, " n"],
    v: Float[Tensor, " n"],
    start: Float[Tensor, " n"],
    stop: Float[Tensor, " n"],
) -> Float[Tensor, " n"]:
    """Query pixels between the front and the back of each wall."""
    x0, y0, _ = project_pixels(matrix, u, v, start)
    x1, y1, _ = project_pixels(matrix, u, v, stop)
    return ((x1 - x0).square() + (y1 - y0).square()).sqrt()
