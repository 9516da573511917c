"""What the Gaussian methods share, with the published values of 3DGS."""

import math
from dataclasses import dataclass

from extrap_train.errors import InputError
from extrap_train.gaussians.checks import check_range, check_word

INITS = ("triangulated", "dense", "random")
BACKGROUNDS = {"black": 0.0, "white": 1.0}
RASTERIZERS = {"numba": "cpu", "gsplat": "cuda"}
"""What draws, and the device that it draws on."""


@dataclass(frozen=True)
class GaussianOptions:
    """Options of the one training loop.

    Everything that counts iterations is written for `full_iterations`, as published, and scaled to
    the `iterations` that are really run; learning rates are raised as `schedule.py` says.
    """

    iterations: int = 1000
    """Steps that are run."""
    full_iterations: int = 30_000
    """Steps that the published numbers below are for."""
    init: str = "triangulated"
    """`triangulated` (SIFT between the inputs, at their poses), `dense` (the depth source's pixels)
    or `random`.
    """
    init_points: int = 1000
    """Points of `random`; `triangulated` is filled up to it with random ones; most of `dense`."""
    init_opacity: float = 0.1
    max_gaussians: int = 10_000
    """Growth stops here, and the result says so."""
    sh_degree: int = 3
    sh_every: int = 1000
    """Iterations after which another degree takes part."""
    ssim_weight: float = 0.2
    l1_weight: float = 0.8
    background: str = "black"
    """`black` or `white`, behind everything."""

    means_rate: float = 1.6e-4
    """Learning rates of Adam; positions in units of the scene's extent, to `means_rate_final`."""
    means_rate_final: float = 1.6e-6
    sh_dc_rate: float = 2.5e-3
    sh_rest_rate: float = 1.25e-4
    opacity_logits_rate: float = 0.05
    log_scales_rate: float = 5e-3
    quats_rate: float = 1e-3

    densify_from: int = 500
    densify_until: int = 15_000
    """0: the number of Gaussians stays as it starts."""
    densify_every: int = 100
    densify_gradient: float = 2e-4
    """Mean length of the loss's gradient to the projected centre, in half image sides (NDC)."""
    densify_least_opacity: float = 0.0
    """Only Gaussians above it are cloned and split."""
    split_scale: float = 0.01
    """Larger ones are split, smaller ones cloned; in extents."""
    prune_opacity: float = 0.005
    prune_scale: float = math.inf
    """Larger ones are removed once opacity has been reset; in extents. Published: 0.1, for millions
    of Gaussians; thousands cannot cover a room with such small ones.
    """
    reset_every: int = 3000
    """0: opacity is never reset."""
    reset_first: int = 3000
    reset_opacity: float = 0.01
    rasterizer: str = "numba"
    """`numba` on the CPU, or `gsplat` on a GPU."""

    @property
    def device(self) -> str:
        """Where a fit runs. Points and depth are prepared, and random numbers drawn, on the CPU."""
        return RASTERIZERS[self.rasterizer]

    def __post_init__(self) -> None:
        """InputError for the first option that cannot be meant."""
        for name in ("iterations", "full_iterations", "max_gaussians", "sh_every"):
            check_range(name, getattr(self, name), 1)
        check_range("init_points", self.init_points, 0)
        check_range("sh_degree", self.sh_degree, 0, 3)
        if not 0 < self.init_opacity < 1:
            raise InputError(f"init_opacity={self.init_opacity}: must be between 0 and 1")
        check_word("init", self.init, INITS)
        check_word("background", self.background, BACKGROUNDS)
        check_word("rasterizer", self.rasterizer, RASTERIZERS)


LEAST_BETWEEN_GROWTH = 25
"""Iterations between two changes of the number of Gaussians: fewer give no mean gradient."""
LEAST_BETWEEN_RESETS = 250
"""Iterations that opacities get to grow back."""


@dataclass(frozen=True)
class Schedule:
    """Maps iteration numbers and learning rates of `full_iterations` to `iterations`.

    Iteration numbers shrink in proportion. Learning rates (all but opacity's, which is quick
    already) grow with the square root: a step's noise then adds up to the same spread, and one that
    always points the same way goes √(full / run) times less far. Intervals keep a least length.
    """

    iterations: int
    full_iterations: int

    @property
    def rate_factor(self) -> float:
        """What learning rates are multiplied with; 1 at the full budget."""
        return math.sqrt(max(1.0, self.full_iterations / self.iterations))

    def at(self, full_iteration: int) -> int:
        """The iteration that stands where `full_iteration` stands in the published schedule."""
        return round(full_iteration * self.iterations / self.full_iterations)

    def due(self, iteration: int, first: int, interval: int, least: int) -> bool:
        """Whether something happens now that the published schedule does at `first` and every
        `interval` from there; never if that is 0, and at most every `least` iterations.
        """
        since = iteration - max(1, self.at(first))
        return interval > 0 and since >= 0 and since % max(least, self.at(interval)) == 0

    def between(self, iteration: int, full_from: float, full_until: float) -> bool:
        """Whether the iteration lies in (from, until) of the published schedule."""
        place = iteration * self.full_iterations / self.iterations
        return full_from < place < full_until


def exponential(start: float, end: float, progress: float) -> float:
    """From `start` to `end` as `progress` goes from 0 to 1, evenly in the logarithm."""
    share = min(max(progress, 0.0), 1.0)
    return math.exp((1 - share) * math.log(start) + share * math.log(end))
