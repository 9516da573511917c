"""Lightning callbacks of a training run: averaged weights, metrics table, progress bar."""

import csv
import io
import math
import time
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback, WeightAveraging
from lightning.pytorch.loggers import Logger
from lightning.pytorch.utilities import rank_zero_only
from torch import nn
from torch.optim.swa_utils import AveragedModel

from extrap_train.errors import InputError
from extrap_train.store.atomic import write_atomic
from extrap_train.terminal import DRAWN_EVERY_S, progress

ABOVE_BASELINES = "validation/above_baselines_db"
"""Of a validation's metrics, what the bar shows."""


class AveragedWeights(WeightAveraging):
    """Exponential moving average with a growing memory: decay min(d, (1 + n)/(10 + n)).

    It lies where the model is trained; an update is one fused operation that waits for nothing.
    """

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


class AveragedModule(AveragedModel):
    """The average of a model's parameters and buffers, all in single precision."""

    def __init__(self, model: nn.Module, device: torch.device, decay: float) -> None:
        super().__init__(model)
        self.module.to(device)  # but not the count, which is read in every step
        self.decay = decay

    @torch.no_grad()
    def update_parameters(self, model: nn.Module) -> None:
        """Move the average towards the model; the first time, copy it."""
        count = int(self.n_averaged)
        decay = min(self.decay, (1 + count) / (10 + count)) if count else 0.0
        average, current = ([*each.parameters(), *each.buffers()] for each in (self.module, model))
        torch._foreach_lerp_(average, current, 1 - decay)
        self.n_averaged += 1


class MetricsTable(Logger):
    """`metrics.csv`: a row per logged step; a resumed run drops the rows behind its checkpoint.

    Lightning's CSVLogger removes the earlier table of a run that resumes.
    """

    def __init__(self, path: Path, resumed_step: int) -> None:
        super().__init__()
        self.path = path
        self._rows = [row for row in _read(path) if int(row["step"]) <= resumed_step]

    @property
    def name(self) -> str:
        """Lightning's name of the logger."""
        return "metrics"

    @property
    def version(self) -> str:
        """Lightning's version of the logger; there is one table a run."""
        return "0"

    def log_hyperparams(self, params: Any, *args: Any, **kwargs: Any) -> None:
        """Nothing: `config.yaml` holds them."""

    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Collect a row; rows of the same step are one."""
        row = {name: f"{value:.6g}" for name, value in metrics.items()}
        if self._rows and self._rows[-1]["step"] == str(step):
            self._rows[-1] |= row
        else:
            self._rows.append({"step": str(step), **row})

    @rank_zero_only
    def save(self) -> None:
        """Write the table whole; Lightning asks every process, and the first one has the rows."""
        columns = list(dict.fromkeys(name for row in self._rows for name in row))
        text = io.StringIO()
        writer = csv.DictWriter(text, columns, restval="")
        writer.writeheader()
        writer.writerows(self._rows)
        write_atomic(self.path, text.getvalue().encode())


def _read(path: Path) -> list[dict[str, str]]:
    if not path.is_file():
        return []
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = [{k: v for k, v in row.items() if k and v} for row in csv.DictReader(file)]
        for row in rows:
            for value in row.values():
                float(value)
            int(row["step"])
    except (csv.Error, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{path}: damaged ({type(error).__name__} {error}); delete it to go on without the "
            "rows of earlier steps"
        ) from None
    return rows


class StepProgress(Callback):
    """One bar for the whole run: steps, time left, loss, and the last validation.

    A GPU is asked for its loss when the bar is drawn and before a checkpoint, not in every step:
    reading a number waits for everything that the device still has to do.
    """

    def __init__(self, steps: int) -> None:
        self.steps = steps
        self._open = ExitStack()
        self._loss = torch.zeros(())
        self._read_at = time.monotonic()
        self._validation = ""

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Open the bar at the step that the run resumes from."""
        bar = progress(
            "train", self.steps, "steps", done=trainer.global_step, shown=trainer.is_global_zero
        )
        self._bar = self._open.enter_context(bar)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Advance, and stop with a clear word if the loss is no number any more."""
        self._loss, note = outputs["loss"], None
        now = time.monotonic()
        if self._loss.device.type == "cpu" or now - self._read_at >= DRAWN_EVERY_S:
            self._read_at = now
            note = f"loss {self._finite_loss(trainer):.4f}{self._validation}"
        self._bar.reach(trainer.global_step, note)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Keep what the bar says of it."""
        self._validation = f", {float(trainer.callback_metrics[ABOVE_BASELINES]):+.2f} dB"

    def on_save_checkpoint(
        self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Save no weights after a loss that is no number: weights that it has reached stay none."""
        self._finite_loss(trainer)

    def _finite_loss(self, trainer: Trainer) -> float:
        loss = float(self._loss)
        if not math.isfinite(loss):
            raise InputError(
                f"the loss is not a number at step {trainer.global_step}: lower "
                "model.learning_rate or set trainer.precision=32-true under another run=NAME"
            )
        return loss

    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Close the bar, also after an error."""
        self._open.close()
