"""One training in two processes: both learn, from different examples, and one leaves the result."""

import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pandas as pd
import pytest
import torch.distributed as dist
from hydra.types import RunMode
from tiny_job import TINY

from extrap_train import cli
from extrap_train.config import TrainConfig
from extrap_train.errors import InputError
from extrap_train.processes import Opening, announce, join

_OPTIONS = [
    *TINY,
    "trainer.steps=2",
    "trainer.checkpoint_every=2",
    "trainer.validate_every=2",
    "trainer.accelerator=cpu",
    "validation.examples=5",
    "validation.batch_size=2",
    "validation.pictures=4",
    "sampler.steps=1",
    "run=here",
]
_NOTING = """
import json, os
from pathlib import Path
from extrap_train.__main__ import main
from extrap_train.data.module import TrainingBatches

read = TrainingBatches.__getitem__

def noted(self, positions):
    with Path(__file__).with_name("seen-" + os.environ.get("LOCAL_RANK", "0")).open("a") as file:
        file.write(json.dumps(positions) + chr(10))
    return read(self, positions)

TrainingBatches.__getitem__ = noted
if __name__ == "__main__":
    main()
"""


def _train(script: Path, output: Path, *more: str) -> str:
    command = [sys.executable, str(script), *_OPTIONS, f"output={output}", *more]
    environment = os.environ | {
        "OMP_NUM_THREADS": "1",
        "NUMBA_NUM_THREADS": "1",
        "PYTHONPATH": str(Path(__file__).parents[1]),
    }
    done = subprocess.run(
        command, capture_output=True, text=True, env=environment, timeout=300, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.slow
def test_two_processes_train_one_model(tmp_path: Path) -> None:
    """What they leave is what one process leaves, and the held-out views are shared out."""
    script = tmp_path / "noting.py"
    script.write_text(_NOTING)
    text = _train(script, tmp_path, "trainer.devices=2")
    run = tmp_path / "train/hydrant/small/here"
    assert text.count("result:") == 1
    assert json.loads((run / "summary.json").read_text())["steps"] == 2
    first, second = (
        [json.loads(line) for line in (tmp_path / f"seen-{rank}").read_text().splitlines()]
        for rank in range(2)
    )
    assert len(first) == len(second) == 2
    positions = [position for batch in first + second for position, _ in batch]
    assert sorted(positions) == list(range(8))
    views = pd.read_csv(run / "validation.csv").groupby("method")["view"]
    assert views.count().eq(5).all()
    assert views.nunique().eq(5).all()
    assert len(pd.read_csv(run / "metrics.csv")) == 1
    assert (run.parent / "latest").resolve() == run.resolve()

    again = _train(script, tmp_path, "trainer.devices=2")
    assert "already trained for 2 steps" in again
    longer = _train(script, tmp_path, "trainer.devices=2", "trainer.steps=4")
    assert longer.count("result:") == 1
    table = pd.read_csv(run / "metrics.csv")
    assert list(table["step"]) == [2, 4]
    positions = [
        position
        for rank in range(2)
        for line in (tmp_path / f"seen-{rank}").read_text().splitlines()
        for position, _ in json.loads(line)
    ]
    assert sorted(positions) == list(range(16))


def test_the_others_join_the_launch_that_opened_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What an earlier launch left is not taken for this one's word."""
    monkeypatch.setenv("SLURM_JOB_ID", "7")
    monkeypatch.setenv("SLURM_STEP_ID", "0")
    told = Opening(is_finished=False, checkpoint="step-00000004.ckpt")
    announce(tmp_path, told)
    assert join(tmp_path, wait_s=0.0) == told
    monkeypatch.setenv("SLURM_RESTART_COUNT", "1")
    with pytest.raises(InputError, match="has not been opened"):
        join(tmp_path, wait_s=0.0)


def test_the_others_end_in_a_line_where_the_first_ends_without_opening(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a torchrun's second process hears it."""

    def closed(values: list[object], **options: object) -> None:
        raise RuntimeError("Connection closed by peer")

    monkeypatch.setattr(dist, "is_initialized", lambda: True)
    monkeypatch.setattr(dist, "broadcast_object_list", closed)
    with pytest.raises(InputError, match=str(tmp_path)):
        join(tmp_path)


@pytest.mark.parametrize(
    "content", [b"", b"[" * 20_000, b'{"launch": {}}', b'{"launch": 3, "opening": {}}', b"\xff"]
)
def test_a_damaged_announcement_is_one_line(tmp_path: Path, content: bytes) -> None:
    (tmp_path / ".opened.json").write_bytes(content)
    with pytest.raises(InputError, match=r"opened\.json"):
        join(tmp_path, wait_s=0.0)


def test_the_job_of_a_sweep_trains_on_one_device(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its other processes would be started with the whole sweep's command."""
    monkeypatch.setattr(
        cli.HydraConfig, "get", staticmethod(lambda: SimpleNamespace(mode=RunMode.MULTIRUN))
    )
    config = TrainConfig()
    cli._check_processes(config)
    config.trainer.devices = 2
    with pytest.raises(InputError, match="trains on one device"):
        cli._check_processes(config)
