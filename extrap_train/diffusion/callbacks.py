"""What a training run shows on its way: averaged weights, a table of metrics, a progress bar."""

import csv
import io
import math
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback, WeightAveraging
from lightning.pytorch.loggers import Logger
from lightning.pytorch.utilities import rank_zero_only
from torch import Tensor

from extrap_train.errors import InputError
from extrap_train.store.atomic import write_atomic
from extrap_train.terminal import progress


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
    """One bar for the whole run: steps, time left, loss, and the last validation."""

    def __init__(self, steps: int) -> None:
        self.steps = steps
        self._open = ExitStack()

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
        loss = float(trainer.callback_metrics["loss"])
        if not math.isfinite(loss):
            raise InputError(
                f"the loss is not a number at step {trainer.global_step}: lower "
                "model.learning_rate or set trainer.precision=32-true under another run=NAME"
            )
        above = trainer.callback_metrics.get("validation/above_baselines_db")
        note = f"loss {loss:.4f}" + (f", {float(above):+.2f} dB" if above is not None else "")
        self._bar.reach(trainer.global_step, note)

    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Close the bar, also after an error."""
        self._open.close()
