"""Depth of matched pixels between two known cameras."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from extrap_train.views import Camera


@dataclass(frozen=True)
class Triangulated:
    """One point a match."""

    depth: Float[Tensor, " n"]
    """In the first camera; not positive where the rays part."""
    parallax_rad: Float[Tensor, " n"]
    """Between the two viewing rays."""
    error: Float[Tensor, " n"]
    """From the match in the second picture to where the point is seen, in pixels."""


def triangulate(
    first_pixels: Float[Tensor, "n 2"],
    second_pixels: Float[Tensor, "n 2"],
    first: Camera,
    second: Camera,
) -> Triangulated:
    """Depth along the first pixel's ray for which the second camera sees it nearest to the match.

    With the ray r at depth z, K₂(z·R r + t) = z·a + b is seen at (u, v): u·(z·a₃ + b₃) = z·a₁ + b₁
    and likewise for v are linear in z and solved in the sense of least squares.
    """
    first_to_second = second.world_to_cam @ first.cam_to_world
    rays = _rays(first_pixels, first)
    turned = rays @ first_to_second[:3, :3].mT
    a, b = turned @ second.intrinsics.mT, second.intrinsics @ first_to_second[:3, 3]
    slope = a[:, :2] - second_pixels * a[:, 2:]
    rest = second_pixels * b[2] - b[:2]
    depth = (slope * rest).sum(-1) / slope.square().sum(-1).clamp_min(1e-12)
    seen = depth[:, None] * a + b
    error = (seen[:, :2] / seen[:, 2:] - second_pixels).norm(dim=-1)
    cosine = functional.cosine_similarity(turned, _rays(second_pixels, second), dim=-1)
    return Triangulated(
        torch.where((seen[:, 2] > 0) & depth.isfinite(), depth, 0),
        torch.acos(cosine.clamp(-1, 1)),
        error.nan_to_num(torch.inf),
    )


def _rays(pixels: Float[Tensor, "n 2"], camera: Camera) -> Float[Tensor, "n 3"]:
    """Viewing rays of depth 1 in the camera's frame."""
    return functional.pad(pixels, (0, 1), value=1.0) @ torch.linalg.inv(camera.intrinsics).mT
