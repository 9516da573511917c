"""What the Gaussian methods share, with the published values of 3DGS."""

import math
from dataclasses import dataclass

from extrap_train.config.options import check_options, option

BACKGROUNDS = {"black": 0.0, "white": 1.0}
RASTERIZERS = {"numba": "cpu", "gsplat": "cuda"}
"""What draws, and the device that it draws on."""


@dataclass(frozen=True)
class GaussianOptions:
    """Options of the one training loop; lengths are in extents of the scene.

    Everything that counts iterations is written for `full_iterations`, as published, and scaled to
    the `iterations` that are really run; learning rates are raised as `Schedule` says.
    """

    iterations: int = option(1000, "steps that are run", low=1)
    full_iterations: int = option(30_000, "steps that the published numbers are for", low=1)
    init: str = option(
        "triangulated",
        "SIFT between the inputs at their poses, the depth source's pixels (dense), or random",
        choices=("triangulated", "dense", "random"),
    )
    init_points: int = option(
        1000, "points of random, most of dense; triangulated is filled up to it at random", low=0
    )
    init_opacity: float = option(0.1, "opacity at the start", low=0.001, high=0.999)
    max_gaussians: int = option(10_000, "growth stops here, and the result says so", low=1)
    sh_degree: int = option(3, "highest degree of the spherical harmonics", low=0, high=3)
    sh_every: int = option(1000, "iterations after which another degree takes part", low=1)
    ssim_weight: float = option(0.2, "weight of 1 - SSIM in the photometric loss", low=0)
    l1_weight: float = option(0.8, "weight of L1 in the photometric loss", low=0)
    background: str = option("black", "behind everything", choices=tuple(BACKGROUNDS))

    means_rate: float = option(1.6e-4, "learning rate of positions, in extents", low=0)
    means_rate_final: float = option(1.6e-6, "the same at the end", low=0)
    sh_dc_rate: float = option(2.5e-3, "learning rate of the constant colour", low=0)
    sh_rest_rate: float = option(1.25e-4, "learning rate of the other harmonics", low=0)
    opacity_logits_rate: float = option(0.05, "learning rate of opacities", low=0)
    log_scales_rate: float = option(5e-3, "learning rate of sizes", low=0)
    quats_rate: float = option(1e-3, "learning rate of rotations", low=0)

    densify_from: int = option(500, "iteration from which Gaussians are added", low=0)
    densify_until: int = option(15_000, "last iteration with growth; 0: none at all", low=0)
    densify_every: int = option(100, "iterations between two growths", low=0)
    densify_gradient: float = option(
        2e-4,
        "least mean gradient of the loss to a projected centre for growth, in half image sides",
        low=0,
    )
    densify_least_opacity: float = option(
        0.0, "only more opaque Gaussians are cloned and split", low=0, high=1
    )
    split_scale: float = option(0.01, "larger Gaussians are split, smaller ones cloned", low=0)
    prune_opacity: float = option(0.005, "fainter Gaussians are removed", low=0, high=1)
    prune_scale: float = option(
        math.inf,
        "larger Gaussians are removed once opacity has been reset (published: 0.1, for millions of "
        "Gaussians; thousands cannot cover a room with such small ones)",
        low=0,
    )
    reset_every: int = option(3000, "iterations between resets of opacity; 0: none", low=0)
    reset_first: int = option(3000, "iteration of the first reset", low=0)
    reset_opacity: float = option(0.01, "opacity after a reset", low=0, high=1)
    rasterizer: str = option(
        "numba", "numba on the CPU, or gsplat on a GPU", choices=tuple(RASTERIZERS)
    )

    @property
    def device(self) -> str:
        """Where a fit runs. Points and depth are prepared, and random numbers drawn, on the CPU."""
        return RASTERIZERS[self.rasterizer]

    def __post_init__(self) -> None:
        """InputError for the first option out of its range."""
        check_options(self)


MIN_BETWEEN_GROWTH = 25
"""Iterations between two changes of the number of Gaussians: fewer give no mean gradient."""
MIN_BETWEEN_RESETS = 250
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


def exponential(start: float, end: float, progress: float) -> float:
    """From `start` to `end` as `progress` goes from 0 to 1, evenly in the logarithm."""
    share = min(max(progress, 0.0), 1.0)
    return math.exp((1 - share) * math.log(start) + share * math.log(end))
