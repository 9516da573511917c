"""Sinusoidal positional encoding of pixel coordinates (paper II-B)."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.geometry.cameras import pixel_grid


def coordinate_grid(
    height: int, width: int, device: torch.device | str = "cpu"
) -> Float[Tensor, "2 h w"]:
    """Normalised (u, v) of every pixel centre of an image, in (−1, 1)."""
    size = torch.tensor([width, height], device=device)
    return (pixel_grid(height, width, device) / size * 2 - 1).permute(2, 0, 1)


def positional_encoding(
    coordinates: Float[Tensor, "b 2 h w"], octaves: int
) -> Float[Tensor, "b {4*octaves} h w"]:
    """Encode normalised (u, v) with frequencies π, 2π, 4π, …

    Channels go by octave, and within one: sin u, sin v, cos u, cos v. At the lowest frequency
    [−1, 1] is one period.
    """
    b, _, h, w = coordinates.shape
    frequencies = math.pi * 2.0 ** torch.arange(octaves, device=coordinates.device)
    angle_rad = coordinates[:, None] * frequencies[:, None, None, None].to(coordinates.dtype)
    return torch.cat([angle_rad.sin(), angle_rad.cos()], 2).reshape(b, 4 * octaves, h, w)
