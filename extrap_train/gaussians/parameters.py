"""Gaussians as an optimiser sees them: unconstrained parameters, one row a Gaussian."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from extrap_train.errors import InputError
from extrap_train.gaussians.gaussians import Gaussians, rgb_to_sh
from extrap_train.gaussians.points import Points

_LEAST_SPACING = 1e-7**0.5


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
        return from_tensors({name: value[rows] for name, value in self.tensors().items()})

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
        return from_tensors({name: value.to(device) for name, value in self.tensors().items()})

    def gaussians(self) -> Gaussians:
        """The values that are drawn; gradients lead back to the parameters."""
        sh = torch.cat([self.sh_dc, self.sh_rest], 1)
        return Gaussians(self.means, self.quats, self.scales, self.opacities, sh)


def from_tensors(tensors: Mapping[str, Tensor]) -> GaussianParameters:
    """The inverse of `GaussianParameters.tensors`."""
    return GaussianParameters(**tensors)


def parameters_from_points(
    points: Points, sh_degree: int, opacity: float, widest: Float[Tensor, " n"] | float = math.inf
) -> GaussianParameters:
    """One round Gaussian a point, as wide as the distance to its three neighbours (3DGS), but at
    most `widest`.

    InputError without points, or where one is not finite.
    """
    if not len(points):
        raise InputError("no initial points in features or depth of the inputs; use init=random")
    if not (points.positions.isfinite().all() and points.colors.isfinite().all()):
        raise InputError("an initial point is not finite; check the depth and the poses given")
    count = len(points)
    spacing = nearest_neighbours(points.positions, 3)[0].square().mean(1).sqrt()
    spacing = torch.minimum(spacing, torch.as_tensor(widest))
    quats = torch.zeros(count, 4)
    quats[:, 0] = 1
    return GaussianParameters(
        means=points.positions.clone(),
        log_scales=spacing.log()[:, None].repeat(1, 3),
        quats=quats,
        opacity_logits=torch.full((count,), math.log(opacity / (1 - opacity))),
        sh_dc=rgb_to_sh(points.colors)[:, None],
        sh_rest=torch.zeros(count, (sh_degree + 1) ** 2 - 1, 3),
    )


def nearest_neighbours(
    positions: Float[Tensor, "n 3"], count: int
) -> tuple[Float[Tensor, "n k"], Int[Tensor, "n k"]]:
    """Distances (at least 3e-4) to the nearest other points, and which they are; k ≤ `count`.

    A point that is alone has itself at distance 1.
    """
    if len(positions) == 1:
        return positions.new_ones(1, 1), positions.new_zeros(1, 1, dtype=torch.long)
    count = min(count, len(positions) - 1)
    array = positions.detach().cpu().double().numpy()
    distance, index = KDTree(array).query(array, k=count + 1)
    found = torch.from_numpy(distance[:, 1:]).float().clamp_min(_LEAST_SPACING)
    return found.to(positions.device), torch.from_numpy(index[:, 1:]).to(positions.device)
