"""Averages of the weights whose length is chosen after training (Karras et al. 2024, section 3).

A power-function average weighs the weights of step t by t^γ, so that it forgets in proportion to
the time trained. Its relative width is the standard deviation of that profile over the length of
the training. Snapshots of two such averages, kept now and then, span a space in which the average
of any other width can be found by least squares, without training again.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

_BISECTIONS = 60


@dataclass(frozen=True)
class Profile:
    """What a power-function average weighs: t^`exponent` up to `step`."""

    step: int
    exponent: float


def exponent_of(relative_width: float) -> float:
    """The exponent γ whose profile has this standard deviation, in shares of the training.

    In (0, 0.288]: σ = √(γ + 1) / ((γ + 2) √(γ + 3)) falls from γ = 0, the plain mean, on.
    """
    low, high = 0.0, 1 / relative_width  # σ < 1 / γ
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        wide = (middle + 1) ** 0.5 / ((middle + 2) * (middle + 3) ** 0.5) > relative_width
        low, high = (middle, high) if wide else (low, middle)
    return (low + high) / 2


def decay_at(step: int, exponent: float) -> float:
    """What an average keeps of itself as it takes in step `step` (from 1): (1 − 1/t)^(γ + 1)."""
    return (1 - 1 / step) ** (exponent + 1)


def mixture(snapshots: Sequence[Profile], wanted: Profile) -> Float[Tensor, " n"]:
    """Shares of the snapshots whose sum is nearest to the wanted profile (least squares over time).

    In float64; they may be negative. A profile that is among the snapshots is itself.
    """
    gram = torch.tensor(
        [[_overlap(a, b) for b in snapshots] for a in snapshots], dtype=torch.float64
    )
    target = torch.tensor([_overlap(a, wanted) for a in snapshots], dtype=torch.float64)
    scale = gram.diagonal().rsqrt()  # late narrow profiles are far higher than early wide ones
    scaled = gram * scale[:, None] * scale
    found = torch.linalg.lstsq(scaled, (target * scale)[:, None], driver="gelsd").solution
    return found[:, 0] * scale


def _overlap(a: Profile, b: Profile) -> float:
    """Integral over time of the product of both normalised profiles."""
    both = min(a.step, b.step)
    ratio = (both / a.step) ** a.exponent * (both / b.step) ** b.exponent
    height = (a.exponent + 1) * (b.exponent + 1) / (a.exponent + b.exponent + 1)
    return height * ratio * both / (a.step * b.step)
