"""Epipolar lines: where wrong depths move a point, and where only wrong poses or chance do."""

import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.views import Camera


def epipolar_directions(
    pixels: Float[Tensor, "n 2"], reference: Camera, query: Camera
) -> Float[Tensor, "n 2"]:
    """Unit vectors along the query's epipolar lines through its `pixels`, signs left open.

    All these lines meet in the epipole, the picture e of the reference's centre: the line through p
    runs along e₁₂ − e₃·p, which holds for an epipole at infinity (e₃ = 0), too. Zero at the epipole
    itself and where both cameras have one centre.
    """
    center = reference.center
    seen = query.world_to_cam[:3, :3] @ center + query.world_to_cam[:3, 3]
    epipole = query.intrinsics @ seen
    towards = epipole[:2] - epipole[2] * pixels
    length = towards.norm(dim=1, keepdim=True)
    return torch.where(length > 0, towards / length.clamp_min(1e-30), 0)


def steps_across(
    pixels: Float[Tensor, "n 2"],
    steps: Float[Tensor, "n 2"],
    reference: Camera,
    query: Camera,
) -> Float[Tensor, " n"]:
    """How far, in pixels, points of the query's picture leave their epipolar lines; ≥ 0."""
    along = epipolar_directions(pixels, reference, query)
    return (steps[:, 0] * along[:, 1] - steps[:, 1] * along[:, 0]).abs()
