"""Averaged weights: an exponential moving average whose memory grows, up to a decay d.

After n models its decay is min(d, (1 + n)/(10 + n)), so that the first ones are soon forgotten.
"""

from collections.abc import Iterable

import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import WeightAveraging
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel


def move_average(
    average: Iterable[Tensor], current: Iterable[Tensor], count: int, most: float
) -> None:
    """Move the average of `count` models, which lies where they do, in place towards the next."""
    decay = min(most, (1 + count) / (10 + count))
    torch._foreach_lerp_([*average], [*current], 1 - decay)


class AveragedModule(AveragedModel):
    """The average of a model's parameters and buffers, all in single precision.

    An update is one fused operation, which waits for nothing on a GPU.
    """

    def __init__(self, model: nn.Module, device: torch.device, decay: float) -> None:
        super().__init__(model)
        self.module.to(device)  # but not the count, which is read in every step
        self.decay = decay

    @torch.no_grad()
    def update_parameters(self, model: nn.Module) -> None:
        """Move the average towards the model; the first time, copy it."""
        count = int(self.n_averaged)
        average, current = ([*each.parameters(), *each.buffers()] for each in (self.module, model))
        move_average(average, current, count, self.decay if count else 0.0)
        self.n_averaged += 1


class AveragedWeights(WeightAveraging):
    """Lightning's callback for an `AveragedModule` of what it trains."""

    def __init__(self, decay: float) -> None:
        super().__init__()
        self.decay = decay

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Make the average on the training device, to which the model itself moves later."""
        if stage == "fit":
            device = trainer.strategy.root_device
            self._average_model = AveragedModule(pl_module, device, self.decay)

    def on_fit_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Hand out the average also where a resumed run had no step left, which skips
        `on_train_end`.
        """
        self._copy_average_to_current(pl_module)
