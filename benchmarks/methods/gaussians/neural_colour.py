"""DNGaussian's colour: a hash grid over space and two small networks (section 3.4)."""

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from benchmarks.methods.gaussians.spherical_harmonics import sh_basis
from extrap_train.errors import InputError

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
        corners = [[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)]
        self.corners = nn.Buffer(torch.tensor(corners))

    @property
    def width(self) -> int:
        """Features a point."""
        return 2 * len(self.cells)

    def forward(self, positions: Float[Tensor, "n 3"]) -> Float[Tensor, "n f"]:
        """Trilinear interpolation of every level's table; positions outside are clamped."""
        unit = ((positions / self.bound + 1) / 2).clamp(0, 1)
        place = unit[:, None] * self.cells[:, None]
        low = place.floor()
        part = (place - low)[:, :, None]
        corner = low.long()[:, :, None] + self.corners
        weight = torch.where(self.corners == 1, part, 1 - part).prod(-1)
        level = torch.arange(len(self.cells), device=positions.device)[:, None] * self.size
        values = self.table[hashed(corner) % self.size + level]
        return (values * weight[..., None]).sum(2).flatten(1)


def hashed(corner: Int[Tensor, "*b 3"]) -> Int[Tensor, "*b"]:
    """The spatial hash of Teschner et al. (2003)."""
    x, y, z = (corner[..., i] * _PRIMES[i] for i in range(3))
    return x ^ y ^ z


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
