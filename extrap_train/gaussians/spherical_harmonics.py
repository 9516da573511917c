"""Colours that depend on the direction of view."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from extrap_train.gaussians.gaussians import SH_DC

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
