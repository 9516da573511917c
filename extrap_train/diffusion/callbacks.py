"""What a training run reports to Lightning's hooks: its table of metrics and its progress bar."""

import math
import time
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.loggers import Logger
from lightning.pytorch.utilities import rank_zero_only

from extrap_train.errors import InputError
from extrap_train.store.atomic import write_atomic
from extrap_train.terminal import DRAWN_EVERY_S, progress

ABOVE_BASELINES = "validation/above_baselines_db"
"""The metric of a validation that the progress bar shows."""


class MetricsTable(Logger):
    """`metrics.csv`: a row per logged step; a resumed run drops the rows behind its checkpoint.

    Lightning's CSVLogger removes the earlier table of a run that resumes.
    """

    def __init__(self, path: Path, resumed_step: int) -> None:
        super().__init__()
        self.path = path
        self._rows = [row for row in _read(path) if row["step"] <= resumed_step]

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
        assert step is not None
        if not self._rows or self._rows[-1]["step"] != step:
            self._rows.append({"step": step})
        self._rows[-1] |= metrics

    @rank_zero_only
    def save(self) -> None:
        """Write the table whole; Lightning asks every process, and the first one has the rows."""
        table = pd.DataFrame(self._rows or {"step": []})
        write_atomic(self.path, table.to_csv(index=False, float_format="%.6g").encode())


def _read(path: Path) -> list[dict[Any, Any]]:
    if not path.is_file():
        return []
    try:
        table = pd.read_csv(path, dtype={"step": int}, index_col=False)
        steps = table.pop("step")
        rows = table.astype(float).to_dict("records")
    except (ValueError, KeyError, OverflowError) as error:
        reason = " ".join(str(error).split())
        raise InputError(
            f"{path}: damaged ({reason}); delete it to go on without the rows of earlier steps"
        ) from None
    return [{"step": step} | row for step, row in zip(steps.tolist(), rows, strict=True)]


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
        """Advance, and stop with a clear word if the loss is not a number any more."""
        self._loss, note = outputs["loss"], None
        now = time.monotonic()
        if self._loss.device.type == "cpu" or now - self._read_at >= DRAWN_EVERY_S:
            self._read_at = now
            note = f"loss {self._finite_loss(trainer):.4f}{self._validation}"
        self._bar.reach(trainer.global_step, note)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Keep what the bar says of it."""
        above = float(trainer.callback_metrics[ABOVE_BASELINES])
        self._validation = f", {above:+.2f} dB over the best baseline"

    def on_save_checkpoint(
        self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Save no weights after a loss that is not a number: those that it has reached stay NaN."""
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
