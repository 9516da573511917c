"""What a run keeps and shows on its way: the averaged weights, a table that forgets what a killed
run did behind its checkpoint, and a bar that keeps no GPU waiting.
"""

import math
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from batches import batch_of
from lightning import LightningModule, Trainer
from lightning.pytorch.accelerators import CPUAccelerator
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.strategies import SingleDeviceStrategy
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode

from extrap_train.config import ModelConfig, TrainConfig
from extrap_train.diffusion import callbacks
from extrap_train.diffusion.averaging import AveragedWeights
from extrap_train.diffusion.callbacks import MetricsTable, StepProgress
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.diffusion.training import CategoryTraining
from extrap_train.errors import InputError
from extrap_train.views import PairBatch


def test_rows_of_one_step_are_one_row_and_new_columns_are_added(tmp_path: Path) -> None:
    table = MetricsTable(tmp_path / "metrics.csv", 0)
    table.log_metrics({"loss": 1.0}, 20)
    table.log_metrics({"psnr": 2.0}, 20)
    table.log_metrics({"loss": 0.5}, 40)
    table.save()
    assert (tmp_path / "metrics.csv").read_text().split() == ["step,loss,psnr", "20,1,2", "40,0.5,"]


def test_a_resumed_table_drops_what_lies_behind_the_checkpoint(tmp_path: Path) -> None:
    path = tmp_path / "metrics.csv"
    table = MetricsTable(path, 0)
    for step in (20, 40, 60):
        table.log_metrics({"loss": float(step)}, step)
    table.save()
    resumed = MetricsTable(path, 40)
    resumed.log_metrics({"loss": 7.0}, 60)
    resumed.save()
    assert path.read_text().split() == ["step,loss", "20,20", "40,40", "60,7"]


def test_a_run_that_ended_before_its_first_row_goes_on(tmp_path: Path) -> None:
    path = tmp_path / "metrics.csv"
    MetricsTable(path, 0).save()
    resumed = MetricsTable(path, 10)
    resumed.log_metrics({"loss": 1.0}, 20)
    resumed.save()
    assert path.read_text().split() == ["step,loss", "20,1"]


@pytest.mark.parametrize(
    "content",
    [
        "loss\n1",
        "step,loss\nx,1",
        "step,loss\n1,[[",
        "step,loss\n\x00,1",
        "step\n1.5",
        "step,loss\n20,1,2\n,3",
        "step,loss\n99999999999999999999,1",
    ],
)
def test_a_damaged_table_is_one_line(tmp_path: Path, content: str) -> None:
    (tmp_path / "metrics.csv").write_text(content)
    with pytest.raises(InputError, match=r"metrics\.csv: damaged"):
        MetricsTable(tmp_path / "metrics.csv", 40)


class _Line(LightningModule):
    """A weight and a buffer that go up by one a step."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(3))
        self.register_buffer("seen", torch.zeros(2))

    def training_step(self, batch: Tensor) -> Tensor:
        self.seen += 1
        return -self.weight.sum()

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.SGD(self.parameters(), lr=1.0)


class _AnyDevice(CPUAccelerator):
    def setup_device(self, device: torch.device) -> None:
        """Nothing: Lightning's own refuses every device but the CPU."""


class _Stream:
    """Batches of a length that Lightning does not ask for, as it would on the device."""

    def __init__(self, batches: list[Any]) -> None:
        self.batches = batches

    def __iter__(self) -> Iterator[Any]:
        return iter(self.batches)


class _OneDevice(SingleDeviceStrategy):
    def teardown(self) -> None:
        """Nothing: Lightning's own brings the model back to the CPU."""


def _fit(module: LightningModule, *callbacks: Callback, data, steps: int, device: str) -> None:
    """Train on a device that Lightning moves the model to after its callbacks are set up.

    Tensors on `meta` have no numbers: whatever waits for one, as it would for a GPU, fails.
    """
    Trainer(
        strategy=_OneDevice(torch.device(device), _AnyDevice()),
        max_steps=steps,
        callbacks=list(callbacks),
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
    ).fit(module, _Stream(data))


def test_the_average_follows_fast_at_first_and_slowly_later() -> None:
    module, average = _Line(), AveragedWeights(0.9)
    _fit(module, average, data=[torch.zeros(1)] * 30, steps=30, device="cpu")
    expected = 1.0
    for count in range(1, 30):
        decay = min(0.9, (1 + count) / (10 + count))
        expected = decay * expected + (1 - decay) * (count + 1)
    for value in (*module.weight.tolist(), *module.seen.tolist()):
        assert value == pytest.approx(expected, rel=1e-6)


def test_the_average_is_kept_where_the_model_is_trained() -> None:
    average = AveragedWeights(0.9)
    _fit(_Line(), average, data=[torch.zeros(1)] * 3, steps=3, device="meta")
    made = average._average_model
    assert {x.device.type for x in (*made.module.parameters(), *made.module.buffers())} == {"meta"}
    assert int(made.n_averaged) == 3


class _NoWaitingCopies(TorchDispatchMode):
    """Refuses copies to another device that hold up this process until they have arrived."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        leaves = kwargs.get("device") is not None and torch.device(kwargs["device"]).type == "meta"
        if func is torch.ops.aten._to_copy.default and leaves and args[0].device.type == "cpu":
            assert kwargs.get("non_blocking"), f"{tuple(args[0].shape)} is waited for"
        return func(*args, **kwargs)


class _Training(CategoryTraining):
    """With an optimiser that any device has."""

    def training_step(self, batch: PairBatch, batch_idx: int) -> Tensor:
        with _NoWaitingCopies():
            return super().training_step(batch, batch_idx)

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), lr=0.1)


@pytest.mark.parametrize("family", ["ours", "zeronvs", "megascenes"])
def test_a_step_waits_for_no_number(
    monkeypatch: pytest.MonkeyPatch, config: ModelConfig, family: str
) -> None:
    """Nor for what it brings to the device. The bar is not drawn meanwhile."""
    monkeypatch.setattr(callbacks, "DRAWN_EVERY_S", math.inf)
    monkeypatch.setattr(torch, "autocast", lambda *_, **__: nullcontext())  # knows no `meta`
    model = ExtrapolationModel(replace(config, family=family))
    batch = batch_of(2, references=1)
    training = _Training(model, TrainConfig(model=model.config), [], None)
    _fit(training, AveragedWeights(0.9), StepProgress(3), data=[batch] * 3, steps=3, device="meta")


def test_the_bar_reads_a_loss_when_it_is_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(callbacks, "DRAWN_EVERY_S", 0.0)
    with pytest.raises(RuntimeError, match="meta"):
        _fit(_Line(), StepProgress(3), data=[torch.zeros(1)] * 3, steps=3, device="meta")


def test_no_checkpoint_is_saved_after_a_loss_that_is_no_number(tmp_path: Path) -> None:
    """Also where the bar has not read it yet."""
    bar = StepProgress(9)
    bar._loss = torch.tensor(math.nan)
    trainer = Trainer(callbacks=[bar], logger=False, enable_checkpointing=False)
    trainer.strategy.connect(_Line())
    with pytest.raises(InputError, match="loss is not a number"):
        trainer.save_checkpoint(tmp_path / "step.ckpt")
    assert not list(tmp_path.iterdir())
