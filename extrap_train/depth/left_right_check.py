"""Left-right consistency: what two views' depths say of each other."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from extrap_train.depth.photo_cost import projection_between
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
    """How many pixels from where it started a pixel returns: there by its own depth, back by the
    other view's. Infinite where the other view does not see the point."""
    there = projection_between(camera, other_camera)
    coordinates, inside = there.normalised_points(inverse_depth)
    found = functional.grid_sample(
        other_inverse_depth[None, None],
        coordinates[None],
        padding_mode="border",
        align_corners=False,
    )[0, 0]
    pixels, _ = there.points(inverse_depth)
    returned = projection_between(other_camera, camera, pixels).points(found)[0]
    grid = pixel_grid(camera.height, camera.width, inverse_depth.device)
    return torch.where(inside, (returned - grid).norm(dim=-1), torch.inf)


def agreement(errors: Float[Tensor, "k h w"]) -> Float[Tensor, "h w"]:
    """Mean of exp(−error²/2) over the better half of the neighbours: 1 is perfect, 0 contradiction.

    Only half of them have to agree: a point may be hidden from the others.
    """
    each = torch.where(errors < LARGEST_ERROR, (-errors.square() / 2).exp(), 0)
    return each.sort(0, descending=True).values[: (len(each) + 1) // 2].mean(0)
