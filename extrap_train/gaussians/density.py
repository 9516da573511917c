"""Where Gaussians are added and removed (3DGS, section 5.2)."""

import math
from dataclasses import dataclass

import roma
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from extrap_train.gaussians.gaussian_model import GaussianParameters
from extrap_train.gaussians.gaussian_options import GaussianOptions
from extrap_train.gaussians.optimiser import GaussianOptimiser
from extrap_train.gaussians.rasterize import Drawing

SPLIT_SHRINK = 1.6
"""Each half of a split Gaussian is this much smaller: 0.8 times their number, 2."""


@dataclass
class GrowthStatistics:
    """What the renderings since the last densification showed of each Gaussian."""

    gradient: Float[Tensor, " n"]
    visits: Float[Tensor, " n"]

    @classmethod
    def empty(cls, means: Float[Tensor, "n 3"]) -> "GrowthStatistics":
        """Nothing seen yet of Gaussians with these means."""
        return cls(*means.new_zeros(2, len(means)))

    @torch.no_grad()
    def add(
        self, gradient: Float[Tensor, "n 2"], radii: Float[Tensor, " n"], height: int, width: int
    ) -> None:
        """One rendering's gradient to the projected centres, per pixel, and radii (0: unseen)."""
        seen = radii > 0
        ndc = gradient * gradient.new_tensor([width / 2, height / 2])
        self.gradient += torch.where(seen, ndc.norm(dim=-1), 0)
        self.visits += seen

    def add_drawing(self, drawing: Drawing) -> None:
        """The same from a drawing whose loss has been differentiated."""
        if drawing.centers.grad is not None:
            radii = drawing.radii[0].amax(-1).float()
            self.add(drawing.centers.grad[0], radii, *drawing.depth.shape)

    def follow(self, kept: Bool[Tensor, " n"], added: int) -> None:
        """The rows that are left, and new ones behind them that nothing has shown yet."""
        for name in ("gradient", "visits"):
            old = getattr(self, name)[kept]
            setattr(self, name, torch.cat([old, old.new_zeros(added)]))

    def mean_gradient(self) -> Float[Tensor, " n"]:
        """Mean length of the gradient in NDC per rendering; 0 for Gaussians that were not seen."""
        return self.gradient / self.visits.clamp_min(1)


@torch.no_grad()
def grow(
    optimiser: GaussianOptimiser,
    statistics: GrowthStatistics,
    options: GaussianOptions,
    generator: torch.Generator,
) -> bool:
    """Clone small and split large Gaussians where the images still pull at them.

    Where that would be more than `max_gaussians`, those with the strongest pull come first; returns
    whether the limit was met. New Gaussians stand behind all old ones.
    """
    now = optimiser.parameters
    pull = statistics.mean_gradient()
    wanted = (pull >= options.densify_gradient) & (now.opacities >= options.densify_least_opacity)
    room = max(options.max_gaussians - len(now), 0)
    limited = int(wanted.sum()) > room
    if limited:
        wanted = strongest(pull, wanted, room)
    large = now.scales.amax(1) > options.split_scale
    splits = wanted & large
    clones, halves = now[wanted & ~large], split_in_two(now[splits], generator)
    optimiser.append(clones)
    optimiser.append(halves)
    added = len(clones) + len(halves)
    optimiser.keep(torch.cat([~splits, splits.new_ones(added)]))
    statistics.follow(~splits, added)
    return limited


def strongest(
    strength: Float[Tensor, " n"], wanted: Bool[Tensor, " n"], count: int
) -> Bool[Tensor, " n"]:
    """The `count` strongest of those that are wanted, ties by their place."""
    order = torch.where(wanted, strength, -math.inf).argsort(descending=True, stable=True)
    kept = torch.zeros_like(wanted)
    kept[order[:count]] = True
    return kept & wanted


def split_in_two(parameters: GaussianParameters, generator: torch.Generator) -> GaussianParameters:
    """Two smaller Gaussians for each, at places drawn from it."""
    twice = {name: torch.cat([value, value]) for name, value in parameters.tensors().items()}
    drawn = torch.randn(len(twice["means"]), 3, generator=generator).to(twice["means"])
    offset = rotation_matrices(twice["quats"]) @ (twice["log_scales"].exp() * drawn)[..., None]
    twice["means"] = twice["means"] + offset[..., 0]
    twice["log_scales"] = twice["log_scales"] - math.log(SPLIT_SHRINK)
    return GaussianParameters(**twice)


def rotation_matrices(quats: Float[Tensor, "n 4"]) -> Float[Tensor, "n 3 3"]:
    """Rotations of quaternions (w, x, y, z) of any length."""
    return roma.unitquat_to_rotmat(roma.quat_wxyz_to_xyzw(functional.normalize(quats, dim=-1)))


@torch.no_grad()
def prune(
    optimiser: GaussianOptimiser,
    statistics: GrowthStatistics,
    options: GaussianOptions,
    large_too: bool,
) -> None:
    """Remove what is nearly transparent and, where `large_too`, what is far too large."""
    now = optimiser.parameters
    useless = now.opacities < options.prune_opacity
    if large_too:
        useless |= now.scales.amax(1) > options.prune_scale
    remove(optimiser, statistics, useless)


@torch.no_grad()
def remove(
    optimiser: GaussianOptimiser, statistics: GrowthStatistics, unwanted: Bool[Tensor, " n"]
) -> None:
    """Remove these Gaussians; if that were all of them, the most opaque one stays."""
    kept = ~unwanted
    if not kept.any():
        kept[optimiser.parameters.opacities.argmax()] = True
    optimiser.keep(kept)
    statistics.follow(kept, 0)


@torch.no_grad()
def reset_opacity(optimiser: GaussianOptimiser, most: float) -> None:
    """No Gaussian is more opaque than `most`: what the images need grows back, the rest goes."""
    capped = optimiser.parameters.opacities.clamp_max(most)
    optimiser.overwrite("opacity_logits", torch.logit(capped))
