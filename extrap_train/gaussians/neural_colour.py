"""DNGaussian's colour: a hash grid over space and two small networks (section 3.4)."""

from collections.abc import Callable

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor, nn

from extrap_train.errors import InputError
from extrap_train.gaussians.spherical_harmonics import sh_basis

_PRIMES = (1, 2_654_435_761, 805_459_861)
_DEGREE = 3


class HashGrid(nn.Module):
    """Multi-resolution hash encoding (Müller et al., 2022) of positions in [−bound, bound]³."""

    def __init__(
        self, levels: int, log2_size: int, coarsest: int, finest: int, bound: float
    ) -> None:
        super().__init__()
        if levels < 2:
            raise InputError(f"hash_levels={levels}: must be at least 2")
        growth = (finest / coarsest) ** (1 / (levels - 1))
        cells = [int(coarsest * growth**level) for level in range(levels)]
        self.cells = nn.Buffer(torch.tensor(cells, dtype=torch.float32))
        self.size, self.bound = 2**log2_size, bound
        self.table = nn.Parameter(torch.empty(levels * self.size, 2).uniform_(-1e-4, 1e-4))
        self.near_far = nn.Buffer(torch.tensor([0, 1]))

    @property
    def width(self) -> int:
        """Features a point."""
        return 2 * len(self.cells)

    def forward(self, positions: Float[Tensor, "n 3"]) -> Float[Tensor, "n f"]:
        """Trilinear interpolation of every level's table; positions outside are clamped."""
        unit = ((positions / self.bound + 1) / 2).clamp(0, 1)
        place = unit[:, None] * self.cells[:, None]
        low = place.floor()
        far = (place - low)[..., None]
        weight = _per_corner(torch.cat([1 - far, far], -1), torch.mul)
        index = hashed(low.long()[..., None] + self.near_far) & (self.size - 1)
        level = torch.arange(len(self.cells), device=positions.device)[:, None] * self.size
        values = self.table[index + level]
        return (values * weight[..., None]).sum(2).flatten(1)


def hashed(sides: Int[Tensor, "*b 3 2"]) -> Int[Tensor, "*b 8"]:
    """The spatial hash of Teschner et al. (2003) at the eight corners of a cell, from the cell's
    two sides along x, y and z; the last axis is the fastest.
    """
    spread = [side * prime for side, prime in zip(sides.unbind(-2), _PRIMES, strict=True)]
    return _per_corner(torch.stack(spread, -2), torch.bitwise_xor)


def _per_corner(
    sides: Shaped[Tensor, "*b 3 2"], combine: Callable[[Tensor, Tensor], Tensor]
) -> Shaped[Tensor, "*b 8"]:
    x, y, z = sides.unbind(-2)
    xy = combine(x[..., :, None], y[..., None, :])
    return combine(xy[..., None], z[..., None, None, :]).flatten(-3)


class NeuralColor(nn.Module):
    """Colour of a point seen from a direction; opacity and shape stay each Gaussian's own."""

    def __init__(self, grid: HashGrid, hidden: int = 64) -> None:
        super().__init__()
        self.grid = grid
        self.spatial = nn.Sequential(
            nn.Linear(grid.width, hidden), nn.ReLU(),
            nn.Linear(hidden, hidden), nn.ReLU(),
            nn.Linear(hidden, hidden),
        )  # fmt: skip
        self.directional = nn.Sequential(
            nn.Linear(hidden + (_DEGREE + 1) ** 2, hidden), nn.ReLU(), nn.Linear(hidden, 3)
        )

    def forward(
        self, positions: Float[Tensor, "n 3"], directions: Float[Tensor, "n 3"]
    ) -> Float[Tensor, "n 3"]:
        """Colours, in about [0, 1]; directions have unit length. No gradient to the positions."""
        feature = self.spatial(self.grid(positions.detach()))
        seen = torch.cat([feature, sh_basis(directions.detach(), _DEGREE)], 1)
        return self.directional(seen).sigmoid() * 1.002 - 0.001
