"""Pictures of a texture that is known everywhere, before and after an exactly known motion."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.geometry.cameras import pixel_grid


def texture(points: Float[Tensor, "*n 2"], seed: int = 0) -> Float[Tensor, "*n 3"]:
    """Waves of 5 to 50 pixels in all directions; colours in [0, 1]."""
    generator = torch.Generator().manual_seed(seed)
    angle_rad = 2 * math.pi * torch.rand(3, 30, generator=generator)
    length = 5 * 10 ** torch.rand(3, 30, generator=generator)
    phase = 2 * math.pi * torch.rand(3, 30, generator=generator)
    waves = 2 * math.pi / length * torch.stack([angle_rad.cos(), angle_rad.sin()])
    sines = torch.sin(torch.einsum("...i,ick->...ck", points, waves) + phase)
    return (0.5 + 0.05 * sines.sum(-1)).clamp(0, 1)


@dataclass(frozen=True)
class Motion:
    """Affine: a pixel p of the first picture goes to `matrix` p + `shift`."""

    matrix: Float[Tensor, "2 2"]
    shift: Float[Tensor, "2"]

    def __call__(self, points: Float[Tensor, "*n 2"]) -> Float[Tensor, "*n 2"]:
        return points @ self.matrix.T + self.shift

    def pictures(
        self, size: tuple[int, int], second_size: tuple[int, int] | None = None
    ) -> tuple[Float[Tensor, "3 h w"], Float[Tensor, "3 h2 w2"]]:
        first = texture(pixel_grid(*size))
        grid = pixel_grid(*(second_size or size))
        second = texture((grid - self.shift) @ torch.linalg.inv(self.matrix).T)
        return first.permute(2, 0, 1), second.permute(2, 0, 1)


def turned(angle_rad: float, scale: float, shift: tuple[float, float], size: int) -> Motion:
    """About the middle of a picture of `size`², then shifted."""
    c, s = scale * math.cos(angle_rad), scale * math.sin(angle_rad)
    matrix, middle = torch.tensor([[c, -s], [s, c]]), torch.full((2,), size / 2)
    return Motion(matrix, middle - matrix @ middle + torch.tensor(shift))
