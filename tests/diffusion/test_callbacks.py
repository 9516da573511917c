"""What a run shows on its way: a table that forgets what a killed run did behind its checkpoint."""

from pathlib import Path

import pytest
import torch

from extrap_train.diffusion.callbacks import AveragedWeights, MetricsTable
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


@pytest.mark.parametrize(
    "content",
    [
        "loss\n1",
        "step,loss\nx,1",
        "step,loss\n1,[[",
        "step,loss\n\x00,1",
        "step\n1.5",
        "step,loss\n20,1,2\n,3",
    ],
)
def test_a_damaged_table_is_one_line(tmp_path: Path, content: str) -> None:
    (tmp_path / "metrics.csv").write_text(content)
    with pytest.raises(InputError, match=r"metrics\.csv: damaged"):
        MetricsTable(tmp_path / "metrics.csv", 40)


def test_the_average_follows_fast_at_first_and_slowly_later() -> None:
    average = AveragedWeights(0.9)._kwargs["avg_fn"]
    old, new = torch.zeros(1), torch.ones(1)
    assert float(average(old, new, 0)) == pytest.approx(0.9)
    assert float(average(old, new, 10_000)) == pytest.approx(0.1)
