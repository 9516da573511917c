"""Left-right consistency: what two views' depths say of each other."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from extrap_train.depth.photo_cost import Projection
from extrap_train.geometry.cameras import pixel_grid
from extrap_train.views import Camera

LARGEST_ERROR = 2.0
"""Forward-backward error, in pixels, from which two depths contradict each other."""


def forward_backward_error(
    inverse_depth: Float[Tensor, "h w"],
    camera: Camera,
    other_inverse_depth: Float[Tensor, "h2 w2"],
    other_camera: Camera,
) -> Float[Tensor, "h w"]:
    """Pixels between where a pixel starts and where it returns to: by its own depth to the other view, back by
    the other's depth there. Infinite where the other view does not see the point."""
    there = Projection.between(camera, other_camera)
    coordinates, inside = there.normalised(inverse_depth)
    found = functional.grid_sample(
        other_inverse_depth[None, None],
        coordinates[None],
        padding_mode="border",
        align_corners=False,
    )[0, 0]
    pixels, _ = there.points(inverse_depth)
    returned = Projection.between(other_camera, camera, pixels).points(found)[0]
    grid = pixel_grid(camera.height, camera.width, inverse_depth.device)
    return torch.where(inside, (returned - grid).norm(dim=-1), torch.inf)


def agreement(errors: Float[Tensor, "k h w"]) -> Float[Tensor, "h w"]:
    """Mean over the better half of the neighbours of exp(−error²/2): 1 is perfect, 0 a contradiction.

    Only half of them have to agree, because a point may be hidden from the others.
    """
    each = torch.where(errors < LARGEST_ERROR, (-errors.square() / 2).exp(), 0)
    return each.sort(0, descending=True).values[: (len(each) + 1) // 2].mean(0)
