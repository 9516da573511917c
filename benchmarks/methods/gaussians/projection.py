"""From Gaussians in the world to ellipses on the image plane (EWA splatting)."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from extrap_train.views import Camera

NEAR_PLANE = 0.01
LOW_PASS = 0.3
"""Variance in px² that every ellipse gains, so that none falls between the pixels."""
LEAST_ALPHA = 1 / 255
"""What covers a pixel less than this is left out."""
MOST_SIGMAS = 3.33
_VIEW_MARGIN = 0.3
"""Slopes are clamped at this share of half the field of view beyond the image's edge."""


@dataclass(frozen=True)
class Ellipses:
    """Gaussians on the image plane of one camera.

    A pixel centre at (dx, dy) from the mean has the exponent ½·(a·(dx − m·dy)² + q·dy²), with
    `shapes` = (a, m, q): precision along x within a row, slope of the centre line, precision
    along y. This is the conic's LDLᵀ factorisation, which keeps its precision where the ellipse
    is thin and long.
    """

    means: Float[Tensor, "n 2"]
    shapes: Float[Tensor, "n 3"]
    depths: Float[Tensor, " n"]
    radii: Float[Tensor, "n 2"]
    """Half the extent in px of where alpha can reach 1/255; zero for what is not drawn."""


def project(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    opacities: Float[Tensor, " n"],
    camera: Camera,
    near_plane: float = NEAR_PLANE,
    low_pass: float = LOW_PASS,
) -> Ellipses:
    """Project by the local affine approximation at each mean, in double precision.

    What lies before the near plane, outside the image, or is too transparent to be seen, and what
    is not a number, is not drawn and gets no gradient.
    """
    m, w2c, k = means.double(), camera.world_to_cam.double(), camera.intrinsics.double()
    cam = m @ w2c[:3, :3].mT + w2c[:3, 3]
    drawn = (cam[:, 2] >= near_plane) & (opacities >= LEAST_ALPHA)
    x, y, z = torch.where(drawn[:, None], cam, 1.0).unbind(-1)
    axes = w2c[:3, :3] @ (rotations(quats.double()) * scales.double()[:, None, :])
    fx, fy, cx, cy = k[0, 0], k[1, 1], k[0, 2], k[1, 2]
    slope_x = _clamped_slope(x / z, fx, cx, camera.width)
    slope_y = _clamped_slope(y / z, fy, cy, camera.height)
    rows = [(axes[:, 0] - slope_x[:, None] * axes[:, 2]) * (fx / z)[:, None]]
    rows += [(axes[:, 1] - slope_y[:, None] * axes[:, 2]) * (fy / z)[:, None]]
    var_x, var_y = rows[0].square().sum(1) + low_pass, rows[1].square().sum(1) + low_pass
    cov = (rows[0] * rows[1]).sum(1)
    slope = cov / var_y
    shapes = torch.stack([1 / (var_x - cov * slope), slope, 1 / var_y], -1)
    means2d = torch.stack([fx * x / z + cx, fy * y / z + cy], -1)
    radii = _radii(opacities.double(), torch.stack([var_x, var_y], -1), drawn)
    size = means2d.new_tensor([camera.width, camera.height])
    inside = ((means2d + radii > 0) & (means2d - radii < size)).all(1) & shapes.isfinite().all(1)
    to = means.dtype
    return Ellipses(
        means2d.to(to), shapes.to(to), z.to(to), torch.where(inside[:, None], radii, 0).to(to)
    )


def rotations(quats: Float[Tensor, "n 4"]) -> Float[Tensor, "n 3 3"]:
    """Rotation matrices of quaternions (w, x, y, z), normalised here."""
    w, x, y, z = functional.normalize(quats, dim=-1).unbind(-1)
    rows = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]
    rows += [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]
    rows += [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    return torch.stack(rows, -1).reshape(-1, 3, 3)


def _clamped_slope(
    slope: Float[Tensor, " n"], focal: Tensor, center: Tensor, size: int
) -> Float[Tensor, " n"]:
    margin = _VIEW_MARGIN * 0.5 * size / focal
    least, most = -center / focal - margin, (size - center) / focal + margin
    return slope.clamp(least, most)


@torch.no_grad()
def _radii(
    opacities: Float[Tensor, " n"], variances: Float[Tensor, "n 2"], drawn: Tensor
) -> Float[Tensor, "n 2"]:
    """Where opacity · exp(−exponent) reaches 1/255, in whole pixels."""
    sigmas = (2 * (opacities / LEAST_ALPHA).clamp(min=1).log()).sqrt().clamp(max=MOST_SIGMAS)
    radii = (sigmas[:, None] * variances.sqrt()).ceil()
    return torch.where(drawn[:, None] & (radii < math.inf), radii, 0)
