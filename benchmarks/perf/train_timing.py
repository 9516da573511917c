"""A training step at the full size's make: mixed precision, fused attention and optimiser, channels
last, against the same network in plain float32.
"""

from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.perf.diffusion_case import Run, Workload, compare_models
from benchmarks.perf.timing import Row
from extrap_train.diffusion.loss import diffusion_loss
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.views import PairBatch

_FORWARD_AND_BACKWARD = 3
"""Operations of a training step over those of a forward pass, by convention."""
_WORKLOADS = {
    kind: Workload("step", _FORWARD_AND_BACKWARD, repeats)
    for kind, repeats in (("cpu", 3), ("cuda", 15))
}


def run() -> list[Row]:
    """One row per device and batch size, on a GPU also with torch.compile."""
    return compare_models(
        _WORKLOADS,
        partial(training_step, optimised=True),
        partial(training_step, optimised=False),
    )


def training_step(model: ExtrapolationModel, batch: PairBatch, *, optimised: bool) -> Run:
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
