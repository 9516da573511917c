"""A training, a sweep or a measurement whose numbers are not numbers fails and leaves no result."""

import json
import math
import sys
from pathlib import Path

import pandas as pd
import pytest
import torch
from tiny_job import TINY

from extrap_train.__main__ import main
from extrap_train.diffusion import training
from extrap_train.diffusion.loss import diffusion_loss
from extrap_train.diffusion.model_files import load_model, save_model
from extrap_train.store.digests import folder_digest

_OPTIONS = [*TINY, "trainer.steps=4", "trainer.checkpoint_every=4", "validation.examples=2"]
_OPTIONS += [
    "trainer.validate_every=4",
    "validation.pictures=1",
    "sampler.steps=1",
    "trainer.precision=32-true",
]


def _run(output: Path, *words: str) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["extrap_train", *_OPTIONS, f"output={output}", *words])
        main()


def _refused(output: Path, *words: str) -> str:
    with pytest.raises(SystemExit) as stopped:
        _run(output, *words)
    assert stopped.value.code not in (0, None)
    said = str(stopped.value)
    assert "\n" not in said
    return said


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of its own, and the data for all others."""
    output = tmp_path_factory.mktemp("trained")
    _run(output)
    return output


@pytest.fixture
def data(trained: Path, tmp_path: Path) -> Path:
    """An output folder with data and no run."""
    for part in trained.iterdir():
        if part.name not in ("train", ".locks"):
            (tmp_path / part.name).symlink_to(part)
    return tmp_path


@pytest.fixture
def diverging(monkeypatch: pytest.MonkeyPatch) -> None:
    """The loss of the third batch is not a number."""
    calls = 0

    def loss(*arguments, **options):
        nonlocal calls
        calls += 1
        return diffusion_loss(*arguments, **options) * (math.nan if calls == 3 else 1)

    monkeypatch.setattr(training, "diffusion_loss", loss)


def test_a_training_that_diverges_fails(diverging: None, data: Path) -> None:
    said = _refused(data)
    assert "loss is not a number at step 3" in said
    assert "model.learning_rate" in said
    assert not list(data.glob("train/**/summary.json"))
    assert not list(data.glob("train/**/model"))


def test_a_training_whose_last_step_ruins_the_weights_fails(
    monkeypatch: pytest.MonkeyPatch, data: Path
) -> None:
    """Every loss was a number; the pictures are none."""

    def step(self, closure=None):
        closure()
        for group in self.param_groups:
            for weight in group["params"]:
                weight.data.fill_(math.inf)

    monkeypatch.setattr(torch.optim.AdamW, "step", step)
    said = _refused(
        data, "trainer.steps=1", "trainer.checkpoint_every=1", "trainer.validate_every=1"
    )
    assert "not finite" in said
    assert not list(data.glob("train/**/summary.json"))
    assert not list(data.glob("train/**/model"))


def test_a_job_that_diverges_is_a_failed_row_of_its_sweep(diverging: None, data: Path) -> None:
    """The first of two; the other one is as it would be alone."""
    sweep = data / "sweep"
    _refused(data, "-m", "seed=0,1", f"hydra.sweep.dir={sweep}")
    rows = pd.read_csv(sweep / "sweep.csv")
    assert list(rows["status"]) == ["failed", "ok"]
    assert len(list(data.glob("train/**/summary.json"))) == 1


def test_a_measurement_of_ruined_weights_fails(trained: Path) -> None:
    run = (trained / "train/hydrant/small/latest").resolve()
    model = load_model(run / "model")
    torch.nn.init.constant_(model.unet.conv_out.bias, math.nan)
    save_model(model, run / "model")
    summary = json.loads((run / "summary.json").read_text())
    summary["model_sha256"] = folder_digest(run / "model")  # as if it had been trained to this
    (run / "summary.json").write_text(json.dumps(summary))
    before = (run / "summary.json").read_bytes()
    assert "not finite" in _refused(trained, "task=validate")
    assert not list(run.glob("validations/*/summary.json"))
    assert (run / "summary.json").read_bytes() == before
