"""What keeps a run alive: whole files, a table that forgets what a killed run did behind its
checkpoint.
"""

import os
from pathlib import Path

import pytest
import torch

from extrap_train.diffusion.callbacks import (
    AveragedWeights,
    MetricsTable,
    WholeCheckpointIO,
    checkpoints,
)
from extrap_train.errors import InputError


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


def test_a_checkpoint_that_cannot_be_written_leaves_nothing(tmp_path: Path) -> None:
    target = tmp_path / "step-00000001.ckpt"
    WholeCheckpointIO().save_checkpoint({"a": torch.ones(2)}, target)
    assert torch.equal(WholeCheckpointIO().load_checkpoint(target)["a"], torch.ones(2))
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        WholeCheckpointIO().save_checkpoint({}, tmp_path / "file" / "step-00000002.ckpt")
    assert checkpoints(tmp_path) == [target]


def test_a_checkpoint_has_its_name_only_once_it_is_on_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    were_there: list[bool] = []
    target = tmp_path / "step-00000001.ckpt"
    monkeypatch.setattr(os, "fsync", lambda _: were_there.append(target.exists()))
    WholeCheckpointIO().save_checkpoint({"a": torch.ones(2)}, target)
    assert were_there == [False, True]


def test_a_checkpoint_with_code_in_it_is_refused(tmp_path: Path) -> None:
    class Evil:
        def __reduce__(self) -> tuple[object, tuple[str]]:
            return print, ("code ran",)

    torch.save({"a": Evil()}, tmp_path / "step-00000001.ckpt")
    with pytest.raises(InputError, match=r"Weights only load failed.*; delete it"):
        WholeCheckpointIO().load_checkpoint(tmp_path / "step-00000001.ckpt")


def test_a_damaged_checkpoint_is_named(tmp_path: Path) -> None:
    path = tmp_path / "step-00000001.ckpt"
    WholeCheckpointIO().save_checkpoint({"a": torch.ones(9)}, path)
    for kept in (0, 10, 300):
        path.write_bytes(path.read_bytes()[:kept] or b"")
        with pytest.raises(InputError, match=r"step-00000001\.ckpt: cannot be resumed from"):
            WholeCheckpointIO().load_checkpoint(path)
        WholeCheckpointIO().save_checkpoint({"a": torch.ones(9)}, path)


def test_the_average_follows_fast_at_first_and_slowly_later() -> None:
    average = AveragedWeights(0.9)._kwargs["avg_fn"]
    old, new = torch.zeros(1), torch.ones(1)
    assert float(average(old, new, 0)) == pytest.approx(0.9)
    assert float(average(old, new, 10_000)) == pytest.approx(0.1)
