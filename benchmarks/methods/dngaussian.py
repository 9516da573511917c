"""DNGaussian (Li et al., 2024): depth normalised over patches, for means and opacities apart."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor, nn

from benchmarks.methods.threedgs import MonocularMethod
from extrap_train.config.options import option
from extrap_train.gaussians.density import remove
from extrap_train.gaussians.gaussian_model import GaussianParameters, Gaussians, sh_basis
from extrap_train.gaussians.gaussian_options import MIN_BETWEEN_GROWTH
from extrap_train.gaussians.init import nearest_expected
from extrap_train.gaussians.losses import fill_unknown, patch_depth_loss
from extrap_train.gaussians.rasterize import draw
from extrap_train.gaussians.recipe import Objective, OptimiserStep, Recipe, Training
from extrap_train.gaussians.training_scene import TrainingScene
from extrap_train.views import Camera

_HARD_OPACITY = 0.95
"""Opacity of every Gaussian in hard depth steps."""
_LOCAL_WEIGHT, _GLOBAL_WEIGHT = 0.1, 1.0
"""Weights of the losses on depth normalised by the patch, and by the image."""
_DEPTH_TOLERANCE = 0.01
"""Smaller differences of depth cost nothing."""
_MIN_PATCH, _MAX_PATCH = 5, 17
"""Sides in pixels; each term draws its own."""
_COARSEST_CELLS, _FINEST_CELLS, _BOUND = 16, 512, 3.0
"""The hash grid's cells along its coarsest level, its cells per extent along the finest, and half
the side of its cube in extents.
"""
_GRID_RATE, _NETWORK_RATE = 5e-3, 5e-4


class DnGaussianRecipe(Recipe):
    """Hard depth moves means, soft depth opacities, and the photograph everything: three optimiser
    steps an iteration.
    """

    options: "DnGaussian"

    def __init__(self, options: "DnGaussian", scene: TrainingScene) -> None:
        super().__init__(options, scene)
        self._priors = [fill_unknown(prior) for prior in options.priors(scene)[1]]
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(scene.seed)
            finest = round(_FINEST_CELLS * _BOUND)
            levels, log2_size = options.hash_levels, options.hash_log2_size
            grid = HashGrid(levels, log2_size, _COARSEST_CELLS, finest, _BOUND)
            self._neural = NeuralColor(grid).to(options.device)
        self._nearest_expected = nearest_expected(self.cameras)
        nearest = float(self._nearest_expected.min())
        scene.record["nearest"] = f"{nearest:.2f} extents from the inputs" if nearest else "unknown"
        self._soft_steps = 0

    def modules(self) -> Sequence[tuple[nn.Module, float, float]]:
        """The grid and the networks, at rates that stay."""
        networks = nn.ModuleList([self._neural.spatial, self._neural.directional])
        return (
            (self._neural.grid, _GRID_RATE, _GRID_RATE),
            (networks, _NETWORK_RATE, _NETWORK_RATE),
        )

    def colors(self, parameters: GaussianParameters, camera: Camera) -> Float[Tensor, "n 3"] | None:
        """The networks' colours."""
        means = parameters.means.detach()
        directions = nn.functional.normalize(means - camera.center.detach(), dim=-1)
        return self._neural(means, directions)

    def steps(self, training: Training) -> Sequence[OptimiserStep]:
        """Hard depth, later on soft depth, and the photograph."""
        late = training.iteration > training.schedule.at(self.options.soft_from)
        soft = (self._soft_step,) if late else ()
        self._soft_steps += len(soft)
        self.scene.record["soft depth"] = f"in {self._soft_steps} iterations"
        return (self._hard_step, *soft, self.photometric_step)

    def adapt(self, training: Training) -> None:
        """As 3DGS; every while, nothing is left right before an input, or unseen by all of them."""
        super().adapt(training)
        every = self.options.clear_every
        if training.schedule.due(training.iteration, 0, every, MIN_BETWEEN_GROWTH):
            unwanted = self._find_misplaced(training.optimiser.parameters)
            remove(training.optimiser, training.statistics, unwanted)

    @torch.no_grad()
    def _find_misplaced(self, parameters: GaussianParameters) -> Bool[Tensor, " n"]:
        before = torch.zeros_like(parameters.opacity_logits, dtype=torch.bool)
        seen = before.clone()
        for camera, nearest in zip(self.cameras, self._nearest_expected, strict=True):
            drawn = self.draw(parameters, camera).radii[0].amax(-1) > 0
            depth = parameters.means @ camera.world_to_cam[2, :3] + camera.world_to_cam[2, 3]
            before |= drawn & (depth < nearest)
            seen |= drawn
        return before | ~seen

    def _hard_step(self, training: Training, index: int) -> Objective:
        now = training.optimiser.parameters.gaussians()
        opaque = torch.full_like(now.opacities, _HARD_OPACITY)
        shown = replace(now, opacities=opaque, scales=now.scales.detach(), quats=now.quats.detach())
        return Objective(self._depth_loss(training, index, shown))

    def _soft_step(self, training: Training, index: int) -> Objective:
        now = training.optimiser.parameters.gaussians()
        shown = replace(
            now, means=now.means.detach(), scales=now.scales.detach(), quats=now.quats.detach()
        )
        return Objective(self._depth_loss(training, index, shown))

    def _depth_loss(
        self, training: Training, index: int, gaussians: Gaussians
    ) -> Float[Tensor, ""]:
        """Local and global terms, each with a patch size of its own."""
        prior = self._priors[index]
        grey = torch.full_like(gaussians.means.detach(), 0.5)
        depth = draw(
            self._rasterize, gaussians, self.camera(index), self.background, 0, grey
        ).depth  # fmt: skip
        if not (prior > 0).any():
            return depth.sum() * 0
        loss = depth.new_zeros(())
        for local, weight in ((True, _LOCAL_WEIGHT), (False, _GLOBAL_WEIGHT)):
            drawn = torch.randint(_MIN_PATCH, _MAX_PATCH + 1, (1,), generator=training.generator)
            term = patch_depth_loss(depth, prior, int(drawn), local, _DEPTH_TOLERANCE)
            loss = loss + weight * term
        return loss


@dataclass(frozen=True)
class DnGaussian(MonocularMethod):
    """Random points, moved by depth first.

    Published values are those for Blender's scenes, whose cameras too stand around an object.
    Two things differ: depth steps are taken in every iteration, not every tenth, and what stands
    right before a camera is removed as in the released training for LLFF. Terms that are published
    for LLFF alone (smooth depth; round, small and opaque Gaussians) are left out.
    """

    recipe = DnGaussianRecipe

    full_iterations: int = 6000
    init: str = "random"
    l1_weight: float = 1.0
    densify_until: int = 6000
    densify_gradient: float = 5e-4
    densify_least_opacity: float = 0.1
    prune_opacity: float = 0.01
    reset_every: int = 0

    soft_from: int = option(1000, "iteration from which opacities follow depth", low=0)
    clear_every: int = option(
        25,
        "iterations after which Gaussians right before a camera, and unseen ones, are removed: "
        "patches know no absolute depth, and a shell there satisfies them all",
        low=0,
    )
    hash_levels: int = option(16, "levels of the hash grid", low=2, high=32)
    hash_log2_size: int = option(19, "entries of a level's table, as a power of 2", low=1, high=30)


_PRIMES = (1, 2_654_435_761, 805_459_861)
_DEGREE = 3


class HashGrid(nn.Module):
    """Multi-resolution hash encoding (Müller et al., 2022) of positions in [−bound, bound]³."""

    def __init__(
        self, levels: int, log2_size: int, coarsest: int, finest: int, bound: float
    ) -> None:
        super().__init__()
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
        index = hash_corners(low.long()[..., None] + self.near_far) & (self.size - 1)
        level = torch.arange(len(self.cells), device=positions.device)[:, None] * self.size
        values = self.table[index + level]
        return (values * weight[..., None]).sum(2).flatten(1)


def hash_corners(sides: Int[Tensor, "*b 3 2"]) -> Int[Tensor, "*b 8"]:
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
