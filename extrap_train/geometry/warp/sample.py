"""References cut into points dense enough that the query sees closed surfaces."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from extrap_train.geometry.cameras import coordinate_grid, pixel_grid
from extrap_train.geometry.spline_flow import flow_at_pixels
from extrap_train.geometry.warp.occlusion import is_occluded
from extrap_train.geometry.warp.query_projection import (
    MIN_DEPTH_RATIO,
    project_pixels,
    reference_to_query_pixels,
    subdivide,
)
from extrap_train.geometry.warp.splat import ScreenPoints
from extrap_train.geometry.warp.surface import Surface, plane_vectors, surface_from_depth
from extrap_train.views import Camera

MAX_SPACING = 1.05
"""Query pixels between neighbouring points of a surface: every pixel centre then lies well inside
a footprint."""
REACH_MARGIN = 0.03
"""Query pixels by which neighbouring pieces of surface overlap, so that no seam shows what is
behind."""
MAX_POINTS_PER_AXIS = 8
"""Points per reference pixel along each axis: a surface stretched further is torn, it was hardly
seen."""


@dataclass(frozen=True)
class Samples:
    """Points of the references' surfaces that face the query camera, with interpolated values."""

    points: ScreenPoints
    values: Float[Tensor, "n 7"]
    """Colour (3), coordinates in the nearest reference (2) and whether it is from there, depth."""
    reference: Int[Tensor, " n"]
    """Which of the b·k references a point is from, in ascending order."""


def sample_surfaces(
    images: Float[Tensor, "b k 3 h w"],
    depths: Float[Tensor, "b k h w"],
    cameras: Camera,
    query: Camera,
) -> Samples:
    """Sample every reference pixel as finely as the query sees it, with its surface's slope and
    values: in torch, differentiable in images and depths."""
    b, k, _, h, w = images.shape
    # Normals, and where depth jumps. The query's centre must lie on the reference's side of the
    # tangent plane n·x = 1, or the query sees the surface's back.
    surface = surface_from_depth(depths, cameras)
    towards = plane_vectors(surface, cameras) * query_centers(cameras, query)[..., None, None, :]
    x, y, z = towards.unbind(-1)
    drawn = surface.valid & (x + y + z < 1)
    # Cut every pixel into as many points as keep them `MAX_SPACING` apart in the query.
    matrix = reference_to_query_pixels(cameras, query)
    steps = _query_steps(surface, matrix)
    counts = torch.where(drawn[..., None], _points_per_axis(steps), 0).reshape(-1, 2)
    pixel, offset = subdivide(counts)
    corner = _Corner.around(surface, pixel, offset)
    # K_q (R K_r⁻¹ (u, v, 1) + t/z): inverse depth is linear on the surface.
    inverse = surface.inverse_depth.reshape(-1)[pixel] + corner.inverse_depth_change(offset)
    u, v, ratio = project_pixels(
        matrix.reshape(-1, 3, 4)[pixel // (h * w)],
        pixel % w + 0.5 + offset[:, 0],
        pixel // w % h + 0.5 + offset[:, 1],
        inverse,
    )
    inside = (u > -0.5) & (u < query.width + 0.5) & (v > -0.5) & (v < query.height + 0.5)
    seen = (inside & (inverse > 0) & (ratio > MIN_DEPTH_RATIO)).nonzero()[:, 0]
    # A point stands for a parallelogram of the query; it reaches half of that one's bounding box.
    edges = (steps.reshape(-1, 2, 2)[pixel[seen]] / counts[pixel[seen], :, None]).abs()
    reach = ((edges[:, 0] + edges[:, 1]) / 2 + REACH_MARGIN).clamp(max=1)
    reference = (pixel // (h * w))[seen]
    depth = (ratio / inverse)[seen]
    points = ScreenPoints(u[seen], v[seen], depth, reach[:, 0], reach[:, 1], reference // k)
    # Drop what lies behind space that its reference never saw, then interpolate what is left.
    occluded = is_occluded(surface, matrix, cameras, query, points, reference)
    kept = (~occluded).nonzero()[:, 0]
    points = points[kept]
    maps = _maps(images).movedim(2, -1).reshape(b * k * h * w, -1)
    values = corner.interpolate(maps, pixel, offset, seen[kept])
    values = torch.cat([values, points.depth[:, None]], 1)
    return Samples(points, values, reference[kept])


def query_centers(cameras: Camera, query: Camera) -> Float[Tensor, "b k 3"]:
    """Where each reference camera sees the query's."""
    return (cameras.world_to_cam @ query.cam_to_world[:, None])[..., :3, 3]


def _maps(images: Float[Tensor, "b k 3 h w"]) -> Float[Tensor, "b k 6 h w"]:
    """Colours, and for the nearest reference its coordinates and 1, for the others 0."""
    b, k, _, h, w = images.shape
    grid = coordinate_grid(h, w, images.device).to(images.dtype)
    nearest = torch.zeros(b, k, 1, h, w, device=images.device, dtype=images.dtype)
    nearest[:, 0] = 1
    return torch.cat([images, grid * nearest, nearest], 2)


def _query_steps(
    surface: Surface, matrix: Float[Tensor, "b k 3 4"]
) -> Float[Tensor, "b k h w 2 2"]:
    """How far (u, v) in the query moves for a step of one reference pixel along u, and along v."""
    h, w = surface.inverse_depth.shape[-2:]
    grid = pixel_grid(h, w, matrix.device).to(matrix.dtype)
    matrix = matrix[..., None, None, :, :]
    u, v, ratio = project_pixels(matrix, grid[..., 0], grid[..., 1], surface.inverse_depth)
    left, right, up, low = surface.slopes.unbind(-3)
    steps = []
    for axis, slope in ((0, (left + right) / 2), (1, (up + low) / 2)):
        x, y, z = (matrix[..., i, axis] + slope * matrix[..., i, 3] for i in range(3))
        steps.append(torch.stack([x - u * z, y - v * z], -1))
    return torch.stack(steps, -2) / ratio.clamp(min=MIN_DEPTH_RATIO)[..., None, None]


def _points_per_axis(steps: Float[Tensor, "b k h w 2 2"]) -> Int[Tensor, "b k h w 2"]:
    """Points along u and v that keep their spacing in the query below `MAX_SPACING`."""
    across, down = steps.detach().square().unbind(-1)
    length = (across + down).sqrt()
    return (length / MAX_SPACING).clamp(max=MAX_POINTS_PER_AXIS).ceil().clamp(min=1).long()


@dataclass(frozen=True)
class _Corner:
    """The two neighbours that each point lies towards."""

    slope: Float[Tensor, "m 2"]
    neighbour: Int[Tensor, "m 2"]
    """The point's own pixel where there is no connection."""

    @classmethod
    def around(
        cls, surface: Surface, pixel: Int[Tensor, " m"], offset: Float[Tensor, "m 2"]
    ) -> "_Corner":
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

    def inverse_depth_change(self, offset: Float[Tensor, "m 2"]) -> Float[Tensor, " m"]:
        """From the pixel's centre to the offset, along the surface."""
        across, down = (self.slope * offset).unbind(-1)
        return across + down

    def interpolate(
        self,
        rows: Float[Tensor, "n c"],
        pixel: Int[Tensor, " m"],
        offset: Float[Tensor, "m 2"],
        chosen: Int[Tensor, " s"],
    ) -> Float[Tensor, "s c"]:
        """Values at the chosen points: the pixel's own, blended with both neighbours'."""
        own = rows[pixel[chosen]]
        towards_u, towards_v = self.neighbour[chosen].unbind(-1)
        share_u, share_v = offset[chosen].abs()[..., None].unbind(-2)
        return own + share_u * (rows[towards_u] - own) + share_v * (rows[towards_v] - own)


def move_points(
    points: ScreenPoints,
    reference: Int[Tensor, " n"],
    flows: Float[Tensor, "b k 2 g g"],
    query: Camera,
) -> ScreenPoints:
    """The points where their reference's flow takes them; differentiable."""
    u, v = points.u.clone(), points.v.clone()
    for index, flow in enumerate(flows.flatten(0, 1)):
        own = (reference == index).nonzero()[:, 0]
        pixels = torch.stack([points.u[own], points.v[own]])
        step = flow_at_pixels(flow, pixels, query.height, query.width)
        u, v = u.index_add(0, own, step[0]), v.index_add(0, own, step[1])
    return replace(points, u=u, v=v)
