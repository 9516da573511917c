"""DNGaussian (Li et al., 2024): depth normalised over patches, for means and opacities apart."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor, nn

from benchmarks.methods.gaussian_method import (
    MONOCULAR,
    GaussianMethod,
    monocular_source,
    prior_depths,
)
from extrap_train.config.options import option
from extrap_train.errors import InputError
from extrap_train.gaussians.density import remove
from extrap_train.gaussians.gaussian_model import GaussianParameters, Gaussians, sh_basis
from extrap_train.gaussians.gaussian_options import MIN_BETWEEN_GROWTH
from extrap_train.gaussians.init import nearest_expected
from extrap_train.gaussians.losses import edge_aware_smoothness, fill_unknown, patch_depth_loss
from extrap_train.gaussians.rasterize import Drawing, draw
from extrap_train.gaussians.recipe import Objective, Recipe, Step, Training
from extrap_train.gaussians.training_scene import TrainingScene
from extrap_train.views import Camera

_OPAQUE = 0.2
"""Opacities above are pulled to 1, those below, as in the released code, too."""


@dataclass(frozen=True)
class DnGaussian(GaussianMethod):
    """Random points, moved by depth first.

    Published values are those for Blender's scenes, whose cameras too stand around an object.
    Two things differ: depth steps are taken in every iteration, not every tenth, and what stands
    right before a camera is removed as in the released training for LLFF.
    """

    full_iterations: int = 6000
    init: str = "random"
    l1_weight: float = 1.0
    densify_until: int = 6000
    densify_gradient: float = 5e-4
    densify_least_opacity: float = 0.1
    prune_opacity: float = 0.01
    reset_every: int = 0

    monocular: str = option(
        "surrogate",
        "monocular depth: the depth source under an unknown affine map, or as it is",
        known=MONOCULAR,
    )
    hard_opacity: float = option(0.95, "opacity in hard depth steps", low=0, high=1)
    soft_from: int = option(1000, "iteration from which opacities follow depth", low=0)
    smooth_from: int = option(3000, "iteration from which depth is smoothed", low=0)
    local_weight: float = option(0.1, "weight of depth normalised by the patch", low=0)
    global_weight: float = option(1.0, "weight of depth normalised by the image", low=0)
    smooth_weight: float = option(
        0.0, "weight of edge-aware smoothness; published: 0.1 for LLFF, none for others", low=0
    )
    depth_tolerance: float = option(0.01, "smaller differences of depth are let be", low=0)
    patch_range: tuple[int, int] = option(
        (5, 17), "smallest and largest side of a patch; each term draws its own", unit="px", low=2
    )
    shape_weight: float = option(
        0.0, "weight of round Gaussians; published: none for Blender, 0.002 for LLFF", low=0
    )
    scale_weight: float = option(
        0.0, "weight of small Gaussians; published: none for Blender, 0.001 for LLFF", low=0
    )
    opacity_weight: float = option(
        0.0, "weight of opacities near 0 or 1; published: none for Blender, 0.001 for LLFF", low=0
    )
    clear_every: int = option(
        25,
        "iterations after which Gaussians right before a camera, and unseen ones, are removed: "
        "patches know no absolute depth, and a shell there satisfies them all",
        low=0,
    )

    color: str = option(
        "neural", "hash grid and networks, or spherical harmonics", known=("neural", "sh")
    )
    hash_levels: int = option(16, "levels of the hash grid", low=2, high=32)
    hash_log2_size: int = option(19, "entries of a level's table, as a power of 2", low=1, high=30)
    hash_coarsest: int = option(16, "cells along the coarsest level", low=1)
    hash_finest: int = option(512, "cells per extent along the finest level", low=1)
    hash_bound: float = option(3.0, "half the side of the grid's cube, in extents", low=0.001)
    grid_rate: float = option(5e-3, "learning rate of the hash grid", low=0)
    network_rate: float = option(5e-4, "learning rate of the networks", low=0)

    def __post_init__(self) -> None:
        """InputError for the first option that cannot be meant."""
        super().__post_init__()
        least, greatest = self.patch_range
        if greatest < least:
            raise InputError(f"patch_range={self.patch_range}: smallest first")

    def recipe(self, scene: TrainingScene) -> Recipe:
        """Three optimiser steps an iteration."""
        return DnGaussianRecipe(self, scene)


class DnGaussianRecipe(Recipe):
    """Hard depth moves means, soft depth opacities, and the photograph everything."""

    options: DnGaussian

    def __init__(self, options: DnGaussian, scene: TrainingScene) -> None:
        super().__init__(options, scene)
        source = monocular_source(scene, options.monocular)
        priors = prior_depths(scene, source, options.device)
        self._priors = [fill_unknown(prior) for prior in priors]
        self._neural = None
        if options.color == "neural":
            with torch.random.fork_rng(devices=[]):
                torch.manual_seed(scene.seed)
                self._neural = NeuralColor(
                    HashGrid(
                        options.hash_levels,
                        options.hash_log2_size,
                        options.hash_coarsest,
                        round(options.hash_finest * options.hash_bound),
                        options.hash_bound,
                    )
                ).to(options.device)
        scene.record["color"] = options.color
        self._nearest_expected = nearest_expected(self.cameras)
        nearest = float(self._nearest_expected.min())
        scene.record["nearest"] = f"{nearest:.2f} extents from the inputs" if nearest else "unknown"
        self._soft_steps = 0

    def modules(self) -> Sequence[tuple[nn.Module, float, float]]:
        """The grid and the networks, at rates that stay."""
        if self._neural is None:
            return ()
        options, networks = self.options, nn.ModuleList()
        networks.extend([self._neural.spatial, self._neural.directional])
        return (
            (self._neural.grid, options.grid_rate, options.grid_rate),
            (networks, options.network_rate, options.network_rate),
        )

    def colors(self, parameters: GaussianParameters, camera: Camera) -> Float[Tensor, "n 3"] | None:
        """The networks' colours, where they are asked for."""
        if self._neural is None:
            return None
        means = parameters.means.detach()
        directions = nn.functional.normalize(means - camera.center.detach(), dim=-1)
        return self._neural(means, directions)

    def steps(self, training: Training) -> Sequence[Step]:
        """Hard depth, later on soft depth, and the photograph."""
        late = training.iteration > training.schedule.at(self.options.soft_from)
        soft = (self._soft_step,) if late else ()
        self._soft_steps += len(soft)
        self.scene.record["soft depth"] = f"in {self._soft_steps} iterations"
        return (self._hard_step, *soft, self.photometric_step)

    def regulariser(
        self, training: Training, index: int, drawing: Drawing
    ) -> Float[Tensor, ""] | float:
        """Round, small, and either opaque or not (as coded: rather opaque)."""
        options, now = self.options, training.optimiser.parameters
        if not (options.shape_weight or options.scale_weight or options.opacity_weight):
            return 0.0
        scales, opacities = now.scales, now.opacities
        high = opacities > _OPAQUE
        away = torch.where(high, -opacities.square(), 0).sum() / high.sum().clamp_min(1)
        low = torch.where(high, 0, (1 - opacities).square()).sum() / (~high).sum().clamp_min(1)
        return (
            options.shape_weight * (scales.amax(1) / scales.amin(1)).mean()
            + options.scale_weight * scales.amax(1).square().mean()
            + options.opacity_weight * (1 + away + low)
        )

    def adapt(self, training: Training) -> None:
        """As 3DGS; every while, nothing is left right before an input, or unseen by all of them."""
        super().adapt(training)
        every = self.options.clear_every
        if training.schedule.due(training.iteration, 0, every, MIN_BETWEEN_GROWTH):
            unwanted = self._misplaced(training.optimiser.parameters)
            remove(training.optimiser, training.statistics, unwanted)

    @torch.no_grad()
    def _misplaced(self, parameters: GaussianParameters) -> Bool[Tensor, " n"]:
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
        opaque = torch.full_like(now.opacities, self.options.hard_opacity)
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
        """Local and global terms, each with a patch size of its own; smoothness later."""
        options, prior = self.options, self._priors[index]
        grey = torch.full_like(gaussians.means.detach(), 0.5)
        depth = draw(
            self._rasterize, gaussians, self.camera(index), self.background, 0, grey
        ).depth  # fmt: skip
        if not (prior > 0).any():
            return depth.sum() * 0
        loss = depth.new_zeros(())
        for local, weight in ((True, options.local_weight), (False, options.global_weight)):
            least, greatest = options.patch_range
            drawn = torch.randint(least, greatest + 1, (1,), generator=training.generator)
            term = patch_depth_loss(depth, prior, int(drawn), local, options.depth_tolerance)
            loss = loss + weight * term
        late = training.iteration > training.schedule.at(options.smooth_from)
        if late and options.smooth_weight > 0:
            loss = loss + options.smooth_weight * edge_aware_smoothness(depth, prior)
        return loss


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
