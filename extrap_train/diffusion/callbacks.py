"""How a run survives: whole checkpoints, a metrics table that knows its step, averaged weights, a
progress bar.
"""

import csv
import io
import os
import pickle
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch
from lightning import LightningModule, Trainer
from lightning.fabric.plugins import TorchCheckpointIO
from lightning.pytorch.callbacks import Callback, WeightAveraging
from lightning.pytorch.loggers import Logger
from lightning.pytorch.utilities import rank_zero_only
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from torch import Tensor

from extrap_train.errors import InputError
from extrap_train.store.atomic import partial_path, replace_synced, write_atomic

_KEPT = 2


class WholeCheckpointIO(TorchCheckpointIO):
    """Writes a checkpoint complete or not at all, and loads it without running any code from it."""

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | os.PathLike[str], storage_options: Any = None
    ) -> None:
        """Write under a temporary name, then rename what has reached the disk."""
        path = Path(path)
        temporary = partial_path(path)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            torch.save(checkpoint, temporary)  # not by way of memory: it is 14 GB at full size
            replace_synced(temporary, path)
        except (OSError, RuntimeError) as error:
            reason = str(error).splitlines()[0]
            raise InputError(
                f"{path}: cannot be written ({reason}); free space or choose another output="
            ) from None
        finally:
            with suppress(OSError):  # the folder itself may be what cannot be written
                temporary.unlink(missing_ok=True)

    def load_checkpoint(
        self,
        path: str | os.PathLike[str],
        map_location: Any = lambda storage, location: storage,
        weights_only: bool | None = True,
    ) -> dict[str, Any]:
        """Load tensors and plain values only; InputError where the file holds anything else."""
        try:
            return torch.load(path, map_location=map_location, weights_only=True)
        except (RuntimeError, OSError, EOFError, pickle.UnpicklingError) as error:
            reason = f"{type(error).__name__} {error}".splitlines()[0]
            raise InputError(
                f"{path}: cannot be resumed from ({reason}); delete it to resume from the "
                "checkpoint before it"
            ) from None


class EpochCheckpoints(Callback):
    """Saves at the end of every epoch and keeps the newest two.

    Epochs are as long as the distance between checkpoints, so that a resumed run starts at the
    first batch of an epoch and sees exactly the batches that it would have seen.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Save, then drop what is older."""
        trainer.save_checkpoint(self.folder / f"step-{trainer.global_step:08d}.ckpt")
        if trainer.is_global_zero:
            for old in checkpoints(self.folder)[:-_KEPT]:
                old.unlink()

    def on_load_checkpoint(
        self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Say that the saved epoch was over.

        Lightning counts an epoch as unfinished while its end's callbacks run; resumed with a limit
        of steps, it would insert an epoch of a single batch.
        """
        progress = checkpoint["loops"]["fit_loop"]
        for span in ("total", "current"):
            epoch = progress["epoch_progress"][span]
            epoch["completed"] = epoch["processed"]
        batches = progress["epoch_loop.batch_progress"]
        batches["current"] = dict.fromkeys(batches["current"], 0)
        batches["is_last_batch"] = False


def checkpoints(folder: Path) -> list[Path]:
    """Complete checkpoints, oldest first."""
    return sorted(folder.glob("step-*.ckpt"))


class AveragedWeights(WeightAveraging):
    """Exponential moving average with a growing memory: decay min(d, (1 + n)/(10 + n))."""

    def __init__(self, decay: float) -> None:
        def average(mean: Tensor, value: Tensor, count: Tensor | int) -> Tensor:
            ramp = (1 + int(count)) / (10 + int(count))
            return mean.lerp(value, 1 - min(decay, ramp))

        super().__init__(avg_fn=average)

    def on_fit_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Hand out the average also where a resumed run had no step left, which skips
        `on_train_end`.
        """
        self._copy_average_to_current(pl_module)


class MetricsTable(Logger):
    """`metrics.csv`: a row per logged step; a resumed run drops the rows behind its checkpoint."""

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
    with path.open(newline="") as file:
        return [{k: v for k, v in row.items() if v} for row in csv.DictReader(file)]


class StepProgress(Callback):
    """One bar for the whole run: steps, time left, loss, and the last validation."""

    def __init__(self, steps: int) -> None:
        self.steps = steps
        self._bar: Progress | None = None
        self._task = TaskID(0)

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Open the bar at the step that the run resumes from."""
        self._bar = Progress(
            TextColumn("train"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.fields[note]}"),
            disable=not trainer.is_global_zero,
        )
        self._bar.start()
        self._task = self._bar.add_task(
            "train", total=self.steps, completed=trainer.global_step, note=""
        )

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Advance, and stop with a clear word where the loss is no number any more."""
        loss = float(trainer.callback_metrics["loss"])
        if not loss == loss:
            raise InputError(
                f"the loss is not a number at step {trainer.global_step}: lower "
                "model.learning_rate or set trainer.precision=32-true under another run=NAME"
            )
        note = f"loss {loss:.4f}"
        above = trainer.callback_metrics.get("validation/above_baselines_db")
        if above is not None:
            note += f", {float(above):+.2f} dB against the best baseline"
        assert self._bar is not None
        self._bar.update(self._task, completed=trainer.global_step, note=note)

    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Close the bar, also after an error."""
        if self._bar is not None:
            self._bar.stop()
