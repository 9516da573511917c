"""A scene of 3D Gaussians, in the units in which it is drawn."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.views import combine

SH_DC = 0.5 / math.sqrt(math.pi)
"""The constant spherical harmonic: a grey of 0.5 + SH_DC · coefficient."""


@dataclass(frozen=True)
class Gaussians:
    """`n` Gaussians. What an optimiser changes (log-scales, logits of the opacities) is its own."""

    means: Float[Tensor, "n 3"]
    """World positions."""
    quats: Float[Tensor, "n 4"]
    """Rotations (w, x, y, z) from the Gaussian's axes to the world, of any length but zero."""
    scales: Float[Tensor, "n 3"]
    """Standard deviations along the own axes, in scene units, positive."""
    opacities: Float[Tensor, " n"]
    """In [0, 1]."""
    sh: Float[Tensor, "n k 3"]
    """Spherical-harmonic coefficients of the colour, k = (degree + 1)² of them a channel."""

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        """Highest degree that the coefficients have."""
        return math.isqrt(self.sh.shape[1]) - 1

    def to(self, device: torch.device | str) -> "Gaussians":
        """The same Gaussians on another device."""
        return combine([self], lambda tensors: tensors[0].to(device))


def rgb_to_sh(rgb: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
    """The degree-0 coefficient whose colour is `rgb`."""
    return (rgb - 0.5) / SH_DC


def sh_to_rgb(sh: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
    """The colour of a degree-0 coefficient alone."""
    return sh * SH_DC + 0.5
