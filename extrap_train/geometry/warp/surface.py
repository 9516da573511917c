"""Surfaces in a depth map: which neighbouring pixels lie on the same one, how it slopes, its
normals (paper II-A).

All of it works on inverse depth: on a plane, at whatever angle, that is exactly linear in pixel
coordinates, so a steep surface and a jump can be told apart by curvature, and nothing depends on
the scene's unit.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from extrap_train.geometry.cameras import pixel_grid
from extrap_train.views import Camera

ALWAYS_SURFACE = 3.0
"""Tangent of the angle between viewing ray and normal up to which two neighbours always form a
surface (72°)."""
DEPTH_NOISE = 0.02
"""Steps up to this share of the depth are not edges: sensors and estimates are as noisy."""
NEVER_SURFACE = 30.0
"""Tangent beyond which they never do (88°)."""
MAX_BEND = 0.7
"""In between: largest change of slope from pixel to pixel that a surface may have, as a share of
the slope."""


@dataclass(frozen=True)
class Surface:
    """A depth map as pieces of surface; slopes are changes of inverse depth per pixel."""

    inverse_depth: Float[Tensor, "*b h w"]
    """0 where depth is unknown."""
    slopes: Float[Tensor, "*b 4 h w"]
    """Towards the left, right, upper and lower neighbour, all counted along +u and +v; where
    there is no connection, the surface is continued from the opposite side."""
    connected: Bool[Tensor, "*b 4 h w"]
    """Whether that neighbour lies on the same surface."""
    ends: Bool[Tensor, "*b 4 h w"]
    """Whether the surface ends on that side, in front of another one."""
    valid: Bool[Tensor, "*b h w"]
    """Known depth, on a surface, and not just behind an occluding edge."""


def surface_from_depth(depth: Float[Tensor, "*b h w"], camera: Camera) -> Surface:
    """Connect the pixels that lie on a common surface.

    Of the two pixels at a jump the nearer one ends its surface; the one behind is dropped, as are
    the mixed depths in between: what they show is partly the occluder.
    """
    known = torch.isfinite(depth) & (depth > 0)
    inverse = torch.where(known, 1 / torch.where(known, depth, 1), 0)
    focal_u, focal_v = camera.intrinsics[..., 0, 0], camera.intrinsics[..., 1, 1]
    across = _sides(inverse, known, focal_u)
    down = _sides(inverse.mT, known.mT, focal_v)
    slopes = [*across.slopes, *(slope.mT for slope in down.slopes)]
    connected = [*across.connected, *(link.mT for link in down.connected)]
    on_surface = (connected[0] | connected[1]) & (connected[2] | connected[3])
    ends = [*across.ends, *(end.mT for end in down.ends)]
    return Surface(
        inverse_depth=inverse,
        slopes=torch.stack(slopes, -3),
        connected=torch.stack(connected, -3),
        ends=torch.stack(ends, -3),
        valid=known & on_surface & ~across.behind & ~down.behind.mT,
    )


def normals_from_depth(
    depth: Float[Tensor, "*b h w"], camera: Camera
) -> tuple[Float[Tensor, "*b h w 3"], Bool[Tensor, "*b h w"]]:
    """Unit normals in the camera's frame, facing the camera, and where they mean something (else
    0)."""
    surface = surface_from_depth(depth, camera)
    away = plane_vectors(surface, camera)
    length = torch.linalg.vector_norm(away, dim=-1, keepdim=True)
    valid = surface.valid & (length[..., 0] > 0)
    return torch.where(valid[..., None], -away / torch.where(length > 0, length, 1), 0), valid


def plane_vectors(surface: Surface, camera: Camera) -> Float[Tensor, "*b h w 3"]:
    """The vector n of each pixel's tangent plane {x: n·x = 1} in the camera's frame: away from
    the camera."""
    left, right, up, low = surface.slopes.unbind(-3)
    k = camera.intrinsics[..., None, None, :, :]
    grid = pixel_grid(camera.height, camera.width, surface.inverse_depth.device)
    grid = grid.to(surface.inverse_depth.dtype)
    # 1/z = n·ray with ray = ((u − cx)/fx, (v − cy)/fy, 1), differentiated by u and v.
    x = (left + right) / 2 * k[..., 0, 0]
    y = (up + low) / 2 * k[..., 1, 1]
    ray_x = (grid[..., 0] - k[..., 0, 2]) / k[..., 0, 0]
    ray_y = (grid[..., 1] - k[..., 1, 2]) / k[..., 1, 1]
    return torch.stack([x, y, surface.inverse_depth - x * ray_x - y * ray_y], -1)


@dataclass(frozen=True)
class _Sides:
    slopes: tuple[Tensor, Tensor]
    connected: tuple[Tensor, Tensor]
    ends: tuple[Tensor, Tensor]
    behind: Tensor


def _sides(
    inverse: Float[Tensor, "*b h w"], known: Bool[Tensor, "*b h w"], focal: Float[Tensor, "*b"]
) -> _Sides:
    """Slopes and connections to the previous and the next pixel along the last dimension."""
    slope = inverse[..., 1:] - inverse[..., :-1]
    both = known[..., 1:] & known[..., :-1]
    # slope · focal / (1/z) is the tangent of the angle between ray and normal, near the optical
    # axis.
    farther = torch.minimum(inverse[..., 1:], inverse[..., :-1])
    limit = farther / focal[..., None, None]
    straight = _on_a_line(slope, both)
    steep = slope.abs()
    linked = both & (
        (steep < ALWAYS_SURFACE * limit)
        | (steep < DEPTH_NOISE * farther)
        | ((steep < NEVER_SURFACE * limit) & straight)
    )
    jump = both & ~linked
    before, after = functional.pad(linked, (1, 0)), functional.pad(linked, (0, 1))
    to_before, to_after = functional.pad(slope, (1, 0)), functional.pad(slope, (0, 1))
    rises, falls = jump & (slope > 0), jump & (slope < 0)
    return _Sides(
        slopes=(
            torch.where(before, to_before, _extend_slope(to_after, after, 1)),
            torch.where(after, to_after, _extend_slope(to_before, before, -1)),
        ),
        connected=(before, after),
        ends=(functional.pad(rises, (1, 0)), functional.pad(falls, (0, 1))),
        behind=functional.pad(falls, (1, 0)) | functional.pad(rises, (0, 1)),
    )


def _extend_slope(
    slope: Float[Tensor, "*b h w"], connected: Bool[Tensor, "*b h w"], inwards: int
) -> Float[Tensor, "*b h w"]:
    """The slope beyond the end of a surface: as it is just inside, changing on as it did there
    (at most twofold)."""
    inner = torch.roll(slope, -inwards, -1)
    known = connected & torch.roll(connected, -inwards, -1)
    grown = torch.where(known, slope - inner, 0)
    grown = torch.where(
        grown * slope > 0, grown.sign() * torch.minimum(grown.abs(), slope.abs()), 0
    )
    return torch.where(connected, slope + grown, 0)


def _on_a_line(
    slope: Float[Tensor, "*b h n"], both: Bool[Tensor, "*b h n"]
) -> Bool[Tensor, "*b h n"]:
    """Whether a step between two pixels is one of three in a row with similar slopes.

    Two are not enough: so looks one pixel of mixed depth between a near and a far surface.
    """
    step = (slope[..., 1:] - slope[..., :-1]).abs()
    largest = torch.maximum(slope[..., 1:].abs(), slope[..., :-1].abs())
    similar = both[..., 1:] & both[..., :-1] & (step <= MAX_BEND * largest)
    three = functional.pad(similar[..., 1:] & similar[..., :-1], (2, 2))
    return three[..., 2:] | three[..., 1:-1] | three[..., :-2]
