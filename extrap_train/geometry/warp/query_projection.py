"""From pixels of a reference, cut into points, to pixels of the query."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from extrap_train.views import Camera

MIN_DEPTH_RATIO = 1e-3
"""Points that much nearer to the query than to the reference are not drawn: they would fill the
image."""


def reference_to_query_pixels(cameras: Camera, query: Camera) -> Float[Tensor, "b k 3 4"]:
    """The matrix from (u, v, 1, 1/z) of a reference pixel to the query's homogeneous pixel times
    z/z_query."""
    reference_to_query = query.world_to_cam[:, None] @ cameras.cam_to_world
    turned = reference_to_query[..., :3, :3] @ torch.linalg.inv(cameras.intrinsics)
    moved = reference_to_query[..., :3, 3:]
    return query.intrinsics[:, None] @ torch.cat([turned, moved], -1)


def project_pixels(
    matrix: Float[Tensor, "*#b 3 4"],
    u: Float[Tensor, "*#b"],
    v: Float[Tensor, "*#b"],
    inverse: Float[Tensor, "*#b"],
) -> tuple[Float[Tensor, "*#b"], Float[Tensor, "*b"], Float[Tensor, "*b"]]:
    """Query pixel and query depth as a multiple of the reference's; meaningless where that is ≤
    0."""
    x, y, ratio = (
        matrix[..., i, 0] * u
        + matrix[..., i, 1] * v
        + matrix[..., i, 2]
        + matrix[..., i, 3] * inverse
        for i in range(3)
    )
    safe = torch.where(ratio > MIN_DEPTH_RATIO, ratio, 1)
    return x / safe, y / safe, ratio


def subdivide(counts: Int[Tensor, "n 2"]) -> tuple[Int[Tensor, " m"], Float[Tensor, "m 2"]]:
    """Each point's pixel, and where in it the point lies: (u, v) from the centre, in (−½, ½)."""
    total = counts[:, 0] * counts[:, 1]
    pixel = torch.repeat_interleave(torch.arange(len(counts), device=counts.device), total)
    nth = torch.arange(len(pixel), device=counts.device) - (total.cumsum(0) - total)[pixel]
    across, down = counts[pixel].unbind(-1)
    column, row = nth % across, nth // across
    return pixel, torch.stack([(column + 0.5) / across, (row + 0.5) / down], -1) - 0.5
