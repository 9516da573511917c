"""A training step at the full size's make: mixed precision, fused attention and optimiser, channels
last, against the same network in plain float32.
"""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.perf.diffusion_case import (
    Size,
    batch_of,
    compare_and_report,
    configuration,
    forward_flops,
    optimised,
    plain,
    run_all,
)
from benchmarks.perf.timing import Row
from extrap_train.diffusion.loss import diffusion_loss
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.views import PairBatch

Step = Callable[[], Float[Tensor, ""]]
_REPEATS = {"cpu": 3, "cuda": 15}
_FORWARD_AND_BACKWARD = 3
"""Operations of a training step over those of a forward pass, by convention."""


def run() -> list[Row]:
    """A row a device and batch size, on a GPU also with torch.compile; prints speed and memory."""
    return run_all(_compare)


def _compare(device: torch.device, size: Size, count: int, compiled: bool) -> Row:
    config = configuration(size)
    model, batch = optimised(config, device), batch_of(count, device)
    reference = training_step(plain(model), batch, optimised=False)
    if compiled:
        model.unet.compile()
    ours = training_step(model, batch, optimised=True)
    case = f"step, {size.name}, batch {count}{', compiled' if compiled else ''}"
    flops = _FORWARD_AND_BACKWARD * count * forward_flops(config)
    repeats = _REPEATS[device.type]
    return compare_and_report(case, device, count, ours, reference, repeats, flops)


def training_step(model: ExtrapolationModel, batch: PairBatch, *, optimised: bool) -> Step:
    """One step on the batch, with an optimiser of its own; it returns the loss."""
    device = batch.image.device
    optimizer = torch.optim.AdamW(
        model.parameters(), lr=1e-5, fused=optimised, foreach=False if not optimised else None
    )

    def step() -> Float[Tensor, ""]:
        generator = torch.Generator().manual_seed(0)
        with torch.autocast(device.type, torch.bfloat16, enabled=optimised):
            loss = diffusion_loss(model, batch, generator, 0.0)
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
        return loss.detach()

    return step
