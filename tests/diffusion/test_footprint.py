"""What a training needs is said beforehand, and one that cannot fit is not begun."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from extrap_train.config import ModelConfig, TrainerConfig
from extrap_train.diffusion import footprint
from extrap_train.diffusion.footprint import Footprint, free_memory, require_room
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.errors import InputError

_OPTIONS = TrainerConfig(accelerator="cpu")


def test_it_counts_what_a_training_really_keeps(config: ModelConfig) -> None:
    """Weights, gradients, two moments and, unless it is switched off, the average."""
    model = ExtrapolationModel(config)
    for average, copies in ((0.999, 5), (0.0, 4)):
        needs = Footprint.of(model, replace(_OPTIONS, ema_decay=average))
        optimizer = torch.optim.AdamW(model.parameters())
        for weight in model.parameters():
            weight.grad = torch.zeros_like(weight)
        optimizer.step()
        moments = sum(
            state[name].nbytes
            for state in optimizer.state.values()
            for name in ("exp_avg", "exp_avg_sq")
        )
        weights = sum(weight.nbytes for weight in model.parameters())
        assert moments == 2 * weights
        assert needs.memory == copies * weights


def test_the_line_names_both_and_what_cannot_fit_is_refused(tmp_path: Path) -> None:
    assert "memory" in require_room(Footprint(2**20, 2**20), _OPTIONS, tmp_path / "run")
    with pytest.raises(InputError, match=r"trainer\.ema_decay"):
        require_room(Footprint(2**60, 0), _OPTIONS, tmp_path)
    with pytest.raises(InputError, match="output="):
        require_room(Footprint(0, 2**60), _OPTIONS, tmp_path)


@pytest.mark.parametrize(
    ("group", "file"),
    [
        ("0::/", "memory.max"),
        ("0::/job_7/step_0/task_0", "job_7/memory.max"),
        ("5:cpu:/a\n4:memory:/job_7/step_0", "memory/job_7/step_0/memory.limit_in_bytes"),
        ("4:memory:/docker/1f", "memory/memory.limit_in_bytes"),
    ],
)
def test_the_limit_of_a_container_or_of_a_job_counts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, group: str, file: str
) -> None:
    """Of control groups of both versions; a job's lies above its own steps'."""
    process, groups = tmp_path / "proc", tmp_path / "cgroup"
    (process / "self").mkdir(parents=True)
    (process / "meminfo").write_text("MemAvailable: 9 kB\n")
    (process / "self/status").write_text("VmRSS: 1 kB\n")
    (process / "self/cgroup").write_text(f"{group}\n")
    monkeypatch.setattr(footprint, "_PROC", process)
    monkeypatch.setattr(footprint, "_CGROUPS", groups)
    assert free_memory(torch.device("cpu")) == 10 * 1024
    (groups / file).parent.mkdir(parents=True)
    (groups / file).write_text("max\n")
    assert free_memory(torch.device("cpu")) == 10 * 1024
    (groups / file).write_text("1000\n")
    assert free_memory(torch.device("cpu")) == 1000
