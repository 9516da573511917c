"""References cut into points dense enough that the query sees closed surfaces."""

from dataclasses import dataclass
from typing import Self

import torch
from jaxtyping import Float, Int
from torch import Tensor

from extrap_train.geometry.cameras import pixel_grid
from extrap_train.geometry.normals import Surface, plane_vectors, surface_from_depth
from extrap_train.geometry.splat import ScreenPoints
from extrap_train.views import Camera

LARGEST_SPACING = 1.05
"""Query pixels between neighbouring points of a surface: every pixel centre then lies well inside a footprint."""
MOST_POINTS = 8
"""Points per reference pixel along each axis: a surface stretched further is torn, it was hardly seen."""
LEAST_DEPTH_RATIO = 1e-3
"""Points that much nearer to the query than to the reference are not drawn: they would fill the image."""


@dataclass(frozen=True)
class Samples:
    """Points of the references' surfaces that face the query camera, with interpolated values."""

    points: ScreenPoints
    values: Float[Tensor, "n c"]


def sample_surfaces(
    depths: Float[Tensor, "b k h w"],
    maps: Float[Tensor, "b k c h w"],
    cameras: Camera,
    query: Camera,
) -> Samples:
    """Sample every reference pixel as finely as the query sees it, with its surface's slope and values."""
    b, k, c, h, w = maps.shape
    surface = surface_from_depth(depths, cameras)
    query_to_reference = cameras.world_to_cam @ query.cam_to_world[:, None]
    # n·x = 1 on the tangent plane; the query's centre must lie on the reference's side of it.
    towards = plane_vectors(surface, cameras) * query_to_reference[..., None, None, :3, 3]
    drawn = surface.valid & (towards.sum(-1) < 1)
    matrix = reference_to_query_pixels(cameras, query)
    counts = torch.where(drawn[..., None], _points_per_axis(surface, matrix), 0)
    pixel, offset = _offsets(counts.reshape(-1, 2))
    corner = _Corner.around(surface, pixel, offset)
    inverse = surface.inverse_depth.reshape(-1)[pixel] + corner.steps(offset)
    u, v, ratio = _project(
        matrix.reshape(-1, 3, 4)[pixel // (h * w)],
        pixel % w + 0.5 + offset[:, 0],
        pixel // w % h + 0.5 + offset[:, 1],
        inverse,
    )
    inside = (u > -0.5) & (u < query.width + 0.5) & (v > -0.5) & (v < query.height + 0.5)
    seen = (inside & (inverse > 0) & (ratio > LEAST_DEPTH_RATIO)).nonzero()[:, 0]
    values = corner.interpolate(maps.movedim(2, -1).reshape(-1, c), pixel, offset, seen)
    image = (pixel // (k * h * w))[seen]
    depth = ratio[seen] / inverse[seen]
    return Samples(ScreenPoints(u[seen], v[seen], depth, image), values)


def reference_to_query_pixels(cameras: Camera, query: Camera) -> Float[Tensor, "b k 3 4"]:
    """The matrix from (u, v, 1, 1/z) of a reference pixel to the query's homogeneous pixel times z/z_query."""
    reference_to_query = query.world_to_cam[:, None] @ cameras.cam_to_world
    turned = reference_to_query[..., :3, :3] @ torch.linalg.inv(cameras.intrinsics)
    moved = reference_to_query[..., :3, 3:]
    return query.intrinsics[:, None] @ torch.cat([turned, moved], -1)


def _project(
    matrix: Float[Tensor, "*b 3 4"],
    u: Float[Tensor, "*b"],
    v: Float[Tensor, "*b"],
    inverse: Float[Tensor, "*b"],
) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b"], Float[Tensor, "*b"]]:
    """Query pixel and query depth as a multiple of the reference's; meaningless where that is ≤ 0."""
    x, y, ratio = (
        matrix[..., i, 0] * u
        + matrix[..., i, 1] * v
        + matrix[..., i, 2]
        + matrix[..., i, 3] * inverse
        for i in range(3)
    )
    safe = torch.where(ratio > LEAST_DEPTH_RATIO, ratio, 1)
    return x / safe, y / safe, ratio


def _points_per_axis(
    surface: Surface, matrix: Float[Tensor, "b k 3 4"]
) -> Int[Tensor, "b k h w 2"]:
    """Points along u and v that keep their spacing in the query below `LARGEST_SPACING`."""
    h, w = surface.inverse_depth.shape[-2:]
    grid = pixel_grid(h, w, matrix.device).to(matrix.dtype)
    matrix = matrix[..., None, None, :, :]
    u, v, ratio = _project(matrix, grid[..., 0], grid[..., 1], surface.inverse_depth)
    left, right, up, low = surface.slopes.unbind(-3)
    counts = []
    for axis, slope in ((0, (left + right) / 2), (1, (up + low) / 2)):
        x, y, z = (matrix[..., i, axis] + slope * matrix[..., i, 3] for i in range(3))
        step = torch.hypot(x - u * z, y - v * z) / ratio.clamp(min=LEAST_DEPTH_RATIO)
        counts.append((step / LARGEST_SPACING).clamp(max=MOST_POINTS).ceil().clamp(min=1))
    return torch.stack(counts, -1).long()


def _offsets(
    counts: Int[Tensor, "n 2"],
) -> tuple[Int[Tensor, "m"], Float[Tensor, "m 2"]]:
    """Each point's pixel, and where in it the point lies: (u, v) from the centre, in (−½, ½)."""
    total = counts[:, 0] * counts[:, 1]
    pixel = torch.repeat_interleave(torch.arange(len(counts), device=counts.device), total)
    nth = torch.arange(len(pixel), device=counts.device) - (total.cumsum(0) - total)[pixel]
    across, down = counts[pixel].unbind(-1)
    column, row = nth % across, nth // across
    return pixel, torch.stack([(column + 0.5) / across, (row + 0.5) / down], -1) - 0.5


@dataclass(frozen=True)
class _Corner:
    """The two neighbours that each point lies towards."""

    slope: Float[Tensor, "m 2"]
    neighbour: Int[Tensor, "m 2"]
    """The point's own pixel where there is no connection."""

    @classmethod
    def around(
        cls, surface: Surface, pixel: Int[Tensor, "m"], offset: Float[Tensor, "m 2"]
    ) -> Self:
        """Pick them by the signs of the offset."""
        h, w = surface.inverse_depth.shape[-2:]
        side = (offset > 0).long() + torch.tensor([0, 2], device=pixel.device)
        flat = (
            (pixel // (h * w) * 4)[:, None] * (h * w) + side * (h * w) + (pixel % (h * w))[:, None]
        )
        step = torch.where(offset > 0, 1, -1) * torch.tensor([1, w], device=pixel.device)
        connected = surface.connected.reshape(-1)[flat]
        neighbour = pixel[:, None] + torch.where(connected, step, 0)
        return cls(surface.slopes.reshape(-1)[flat], neighbour)

    def steps(self, offset: Float[Tensor, "m 2"]) -> Float[Tensor, "m"]:
        """Change of inverse depth from the pixel's centre."""
        return (self.slope * offset).sum(-1)

    def interpolate(
        self,
        rows: Float[Tensor, "n c"],
        pixel: Int[Tensor, "m"],
        offset: Float[Tensor, "m 2"],
        chosen: Int[Tensor, "s"],
    ) -> Float[Tensor, "s c"]:
        """Values at the chosen points: the pixel's own, blended with both neighbours'."""
        own = rows[pixel[chosen]]
        towards_u, towards_v = self.neighbour[chosen].unbind(-1)
        share_u, share_v = offset[chosen].abs()[..., None].unbind(-2)
        return own + share_u * (rows[towards_u] - own) + share_v * (rows[towards_v] - own)
