"""A training step at the full size's make: mixed precision, fused attention and optimiser, channels
last, against the same network in plain float32.
"""

from collections.abc import Callable
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.perf.diffusion_case import Run, compare_models
from benchmarks.perf.timing import Timing, devices
from extrap_train.diffusion.loss import diffusion_loss
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.diffusion.step_noise import StepNoise
from extrap_train.views import PairBatch

_FORWARD_AND_BACKWARD = 3
"""Operations of a training step over those of a forward pass, by convention."""
_REPEATS = {"cpu": 3, "cuda": 15}


def run() -> list[Timing]:
    """One row per device and batch size, on a GPU also with torch.compile."""

    def step(model: ExtrapolationModel, batch: PairBatch, *, is_ours: bool) -> Run:
        return training_step(model, lambda: batch, optimised=is_ours)

    ours, plain = (partial(step, is_ours=is_ours) for is_ours in (True, False))
    return [
        row
        for device in devices()
        for row in compare_models(
            device, "step", _FORWARD_AND_BACKWARD, ours, plain, _REPEATS[device.type]
        )
    ]


def training_step(
    model: ExtrapolationModel, next_batch: Callable[[], PairBatch], *, optimised: bool
) -> Run:
    """One step on the next batch, with an optimiser of its own; it returns the loss."""
    device = next(model.parameters()).device
    optimizer = torch.optim.AdamW(
        model.parameters(), lr=1e-5, fused=optimised, foreach=False if not optimised else None
    )

    def step() -> Float[Tensor, ""]:
        batch, draws = next_batch(), StepNoise(torch.Generator().manual_seed(0))
        with torch.autocast(device.type, torch.bfloat16, enabled=optimised):
            loss = diffusion_loss(model, batch, draws, 0.0)
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
        return loss.detach()

    return step
