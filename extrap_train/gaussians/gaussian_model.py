"""A scene of 3D Gaussians: as it is drawn, as an optimiser moves it, and its colours."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

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
    """The degree-0 coefficient that gives the colour `rgb`."""
    return (rgb - 0.5) / SH_DC


_DEGREE_1 = 0.4886025119029199
_DEGREE_2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
_DEGREE_3 = (
    0.5900435899266435,
    2.890611442640554,
    0.4570457994644658,
    0.3731763325901154,
    1.445305721320277,
)


def sh_basis(directions: Float[Tensor, "*b 3"], degree: int) -> Float[Tensor, "*b k"]:
    """Real spherical harmonics up to `degree` (0 to 3) at unit directions, in 3DGS's order and
    signs."""
    x, y, z = directions.unbind(-1)
    basis = [torch.full_like(x, SH_DC)]
    if degree > 0:
        basis += [-_DEGREE_1 * y, _DEGREE_1 * z, -_DEGREE_1 * x]
    if degree > 1:
        a, b, c = _DEGREE_2
        basis += [a * x * y, -a * y * z, b * (2 * z * z - x * x - y * y)]
        basis += [-a * x * z, c * (x * x - y * y)]
    if degree > 2:
        a, b, c, d, e = _DEGREE_3
        zonal = 4 * z * z - x * x - y * y
        basis += [-a * y * (3 * x * x - y * y), b * x * y * z, -c * y * zonal]
        basis += [d * z * (2 * z * z - 3 * x * x - 3 * y * y), -c * x * zonal]
        basis += [e * z * (x * x - y * y), -a * x * (x * x - 3 * y * y)]
    return torch.stack(basis, -1)


def sh_colors(
    sh: Float[Tensor, "n k 3"], means: Float[Tensor, "n 3"], center: Float[Tensor, "3"], degree: int
) -> Float[Tensor, "n 3"]:
    """max(0, ½ + Σ coefficient · harmonic) in the direction from the camera to each Gaussian.

    Uses the first (degree + 1)² coefficients.
    """
    basis = sh_basis(functional.normalize(means - center, dim=-1), degree)
    return (0.5 + (basis[..., None] * sh[:, : basis.shape[-1]]).sum(1)).clamp(min=0)


@dataclass(frozen=True)
class GaussianParameters:
    """What Adam moves; `gaussians()` is what it stands for."""

    means: Float[Tensor, "n 3"]
    log_scales: Float[Tensor, "n 3"]
    quats: Float[Tensor, "n 4"]
    """(w, x, y, z), of any length but 0."""
    opacity_logits: Float[Tensor, " n"]
    sh_dc: Float[Tensor, "n 1 3"]
    """The constant spherical harmonic's coefficients, which have a learning rate of their own."""
    sh_rest: Float[Tensor, "n k 3"]
    """The other coefficients: none at degree 0, 15 at degree 3."""

    def __len__(self) -> int:
        return len(self.means)

    def __getitem__(self, rows: Bool[Tensor, " n"] | Int[Tensor, " m"]) -> "GaussianParameters":
        return combine([self], lambda tensors: tensors[0][rows])

    @property
    def scales(self) -> Float[Tensor, "n 3"]:
        """Standard deviations along the axes."""
        return self.log_scales.exp()

    @property
    def opacities(self) -> Float[Tensor, " n"]:
        """In (0, 1)."""
        return self.opacity_logits.sigmoid()

    def tensors(self) -> dict[str, Tensor]:
        """All parameters by name, not copied."""
        return dict(vars(self))

    def to(self, device: torch.device | str) -> "GaussianParameters":
        """The same parameters on another device."""
        return combine([self], lambda tensors: tensors[0].to(device))

    def gaussians(self) -> Gaussians:
        """The values that are drawn; gradients lead back to the parameters."""
        sh = torch.cat([self.sh_dc, self.sh_rest], 1)
        return Gaussians(self.means, self.quats, self.scales, self.opacities, sh)
