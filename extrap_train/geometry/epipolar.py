"""Two posed pictures: epipolar lines, along which wrong depths move a point and across which only
wrong poses or chance do, and the depth of matched pixels.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from extrap_train.views import Camera


def fundamental_matrix(first: Camera, second: Camera) -> Float[np.ndarray, "3 3"]:
    """F with p₂ᵀ F p₁ = 0 for homogeneous pixels of one point, from the known cameras.

    F = K₂⁻ᵀ [t]ₓ R K₁⁻¹ with the motion (R, t) from the first camera to the second; double
    precision. Zero where both cameras have one centre.
    """
    motion = (second.world_to_cam.double() @ first.cam_to_world.double()).numpy(force=True)
    x, y, z = motion[:3, 3]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    inverse_first, inverse_second = (
        np.linalg.inv(camera.intrinsics.double().numpy(force=True)) for camera in (first, second)
    )
    return inverse_second.T @ cross @ motion[:3, :3] @ inverse_first


def epipolar_lines(
    pixels: Float[np.ndarray, "n 2"], fundamental: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "n 3"]:
    """Line of each pixel in the other picture; its product with a homogeneous pixel is the signed
    distance in pixels."""
    lines = homogeneous(pixels) @ fundamental.T
    return lines / np.maximum(np.linalg.norm(lines[:, :2], axis=1, keepdims=True), 1e-30)


def epipolar_distance(
    first: Float[np.ndarray, "n 2"],
    second: Float[np.ndarray, "n 2"],
    fundamental: Float[np.ndarray, "3 3"],
) -> Float[np.ndarray, " n"]:
    """Pixels between each second point and the epipolar line of the first."""
    return np.abs((epipolar_lines(first, fundamental) * homogeneous(second)).sum(1))


def homogeneous(pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    """(u, v, 1)."""
    return np.concatenate([pixels, np.ones((len(pixels), 1))], 1)


def epipolar_directions(
    pixels: Float[Tensor, "n 2"], reference: Camera, query: Camera
) -> Float[Tensor, "n 2"]:
    """Unit vectors along the query's epipolar lines through its `pixels`, with either sign.

    All these lines meet in the epipole, the picture e of the reference's centre: the line through p
    runs along e₁₂ − e₃·p, also for an epipole at infinity (e₃ = 0). Zero at the epipole itself and
    where both cameras have one centre.
    """
    center = reference.center
    seen = query.world_to_cam[:3, :3] @ center + query.world_to_cam[:3, 3]
    epipole = query.intrinsics @ seen
    towards = epipole[:2] - epipole[2] * pixels
    length = towards.norm(dim=1, keepdim=True)
    return torch.where(length > 0, towards / length.clamp_min(1e-30), 0)


def steps_across(
    pixels: Float[Tensor, "n 2"], steps: Float[Tensor, "n 2"], reference: Camera, query: Camera
) -> Float[Tensor, " n"]:
    """How far, in pixels, points of the query's picture leave their epipolar lines; ≥ 0."""
    along = epipolar_directions(pixels, reference, query)
    return (steps[:, 0] * along[:, 1] - steps[:, 1] * along[:, 0]).abs()


@dataclass(frozen=True)
class Triangulated:
    """One point per match."""

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
    rays = viewing_rays(first_pixels, first)
    turned = rays @ first_to_second[:3, :3].mT
    a, b = turned @ second.intrinsics.mT, second.intrinsics @ first_to_second[:3, 3]
    slope = a[:, :2] - second_pixels * a[:, 2:]
    rest = second_pixels * b[2] - b[:2]
    depth = (slope * rest).sum(-1) / slope.square().sum(-1).clamp_min(1e-12)
    seen = depth[:, None] * a + b
    error = (seen[:, :2] / seen[:, 2:] - second_pixels).norm(dim=-1)
    cosine = functional.cosine_similarity(turned, viewing_rays(second_pixels, second), dim=-1)
    return Triangulated(
        torch.where((seen[:, 2] > 0) & depth.isfinite(), depth, 0),
        torch.acos(cosine.clamp(-1, 1)),
        error.nan_to_num(torch.inf),
    )


def viewing_rays(pixels: Float[Tensor, "n 2"], camera: Camera) -> Float[Tensor, "n 3"]:
    """Viewing rays of depth 1 in the camera's frame."""
    return functional.pad(pixels, (0, 1), value=1.0) @ torch.linalg.inv(camera.intrinsics).mT
