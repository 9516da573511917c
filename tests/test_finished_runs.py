"""What has been learnt stays: no other command replaces or rewrites a run unasked."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import yaml
from opened_runs import begun, hydrant_config, opened

from extrap_train.config import (
    TrainConfig,
    ValidationConfig,
)
from extrap_train.errors import InputError
from extrap_train.runs import (
    Finished,
    RunFolder,
    newest_run,
)
from extrap_train.store.manifest import Conflict, read_manifest

_OPENED = {"config.yaml", "manifest.json", ".opened.json"}


def _summary(steps: int) -> str:
    measured = {"validation": asdict(ValidationConfig())}
    return json.dumps({"steps": steps, "provenance": measured})


def _content(run: RunFolder) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in run.path.rglob("*") if path.is_file()}


def _of_steps(config: TrainConfig, steps: int, run: str | None = None) -> TrainConfig:
    return replace(config, run=run, trainer=replace(config.trainer, steps=steps))


@pytest.fixture
def config(tmp_path: Path) -> TrainConfig:
    return hydrant_config(tmp_path)


def test_starting_over_leaves_nothing_of_the_run(config: TrainConfig) -> None:
    """Else a new run that is killed early would be taken for the finished old one, or would lie
    among its pictures and model."""
    run = begun(config)
    run.summary.write_text(_summary(config.trainer.steps))
    for part in (run.model, run.samples, run.path / "tensorboard"):
        part.mkdir()
        (part / "file").touch()
    (run.path / "validation.csv").touch()
    opened(config)
    assert run.summary.exists()
    assert (run.model / "file").exists()
    opened(replace(config, resume=False))
    assert {path.name for path in run.path.iterdir()} == _OPENED
    left = {path.name for path in run.path.parent.iterdir() if path.suffix != ".lock"}
    assert left == {run.path.name, "latest", ".lock"}


def test_a_run_that_has_learnt_nothing_binds_nobody(config: TrainConfig) -> None:
    """Neither to its options nor to its data, as where it was killed before a checkpoint."""
    mine = replace(config, run="mine")
    run = opened(mine)
    (run.path / "metrics.csv").touch()
    changed = replace(mine, model=replace(config.model, learning_rate=0.5))
    assert opened(changed, "other") == run
    assert read_manifest(run.path).inputs == {"data of hydrant": "other"}
    assert yaml.safe_load(run.options.read_text())["model"]["learning_rate"] == 0.5
    assert {path.name for path in run.path.iterdir()} == _OPENED


@pytest.mark.parametrize("mark", ["checkpoints/step-00000003.ckpt", "summary.json", "model/unet"])
def test_a_run_that_has_learnt_is_not_opened_with_other_data(
    config: TrainConfig, mark: str
) -> None:
    run = opened(config)
    (run.path / mark).parent.mkdir(exist_ok=True)
    (run.path / mark).touch()
    before = _content(run)
    longer = replace(config, trainer=replace(config.trainer, steps=9))
    with pytest.raises(Conflict, match="data of hydrant"):
        opened(longer, "other")
    assert _content(run) == before


@pytest.mark.parametrize("steps", [1, 19, 20])
def test_a_finished_run_is_not_rewritten_by_a_shorter_one(config: TrainConfig, steps: int) -> None:
    run = opened(_of_steps(config, 20))
    run.summary.write_text(_summary(20))
    told = {run.path / ".opened.json"}
    before = {path: content for path, content in _content(run).items() if path not in told}
    opened(_of_steps(config, steps))
    assert {path: content for path, content in _content(run).items() if path not in told} == before


def test_a_finished_run_without_checkpoints_is_not_replaced_by_a_shorter_one(
    config: TrainConfig,
) -> None:
    run = opened(_of_steps(config, 20))
    run.summary.write_text(_summary(20))
    before = _content(run)
    otherwise = replace(config, validation=replace(config.validation, examples=3))
    with pytest.raises(Conflict, match=r"trainer\.steps \(was 20, now 9\)"):
        opened(_of_steps(otherwise, 9))
    assert _content(run) == before


@pytest.fixture
def _sweeping(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("extrap_train.runs.in_sweep", lambda: True)


@pytest.mark.usefixtures("_sweeping")
def test_a_sweeps_jobs_have_runs_of_exactly_their_options(config: TrainConfig) -> None:
    measured = replace(config, validation=replace(config.validation, examples=3))
    jobs = [_of_steps(config, 20), _of_steps(config, 30), measured, replace(config, seed=1)]
    assert len({opened(job).path for job in jobs}) == 4
    assert opened(jobs[0]) == opened(jobs[0])
    assert not newest_run(config).path.exists(), "latest is never a sweep's job"


@pytest.mark.usefixtures("_sweeping")
@pytest.mark.parametrize("steps", [19, 21])
def test_a_sweeps_job_takes_no_named_run_of_another_length(config: TrainConfig, steps: int) -> None:
    run = opened(_of_steps(config, 20, "mine"))
    run.summary.write_text(_summary(20))
    before = _content(run)
    with pytest.raises(Conflict, match=rf"trainer\.steps \(was 20, now {steps}\)"):
        opened(_of_steps(config, steps, "mine"))
    assert _content(run) == before


def test_a_single_command_does_not_share_a_sweeps_run(
    config: TrainConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    alone = opened(config)
    monkeypatch.setattr("extrap_train.runs.in_sweep", lambda: True)
    assert opened(config) != alone


@pytest.mark.parametrize(
    "content",
    [
        b"\xff\xfe\xfa",
        b"a: &a [*a]",
        b"a: &a [x, x]\nb: &b [*a, *a]\nc: [*b, *b]",
        b"[" * 20_000,
        b"- a",
        b"model: resnet\nepochs: 90",
    ],
)
def test_options_of_somebody_else_are_not_overwritten(config: TrainConfig, content: bytes) -> None:
    saved = begun(replace(config, run="mine")).options
    saved.write_bytes(content)
    with pytest.raises(InputError, match=r"config\.yaml: .*run=NAME"):
        opened(replace(config, run="mine"))
    assert saved.read_bytes() == content


def test_a_run_answers_for_fewer_steps_measured_alike(config: TrainConfig, tmp_path: Path) -> None:
    run = RunFolder(tmp_path)
    run.summary.write_text(_summary(20))
    finished = Finished.read(run)
    assert finished.steps == 20
    assert finished.answers(_of_steps(config, 10))
    assert finished.answers(_of_steps(config, 20))
    assert not finished.answers(_of_steps(config, 21))
    otherwise = replace(config, validation=replace(config.validation, examples=3))
    assert not finished.answers(_of_steps(otherwise, 10))


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b'{"steps": 2',
        b"[]",
        b"3",
        b"\xff\xfe",
        b'{"steps": 20}',
        b'{"steps": []}',
        b'{"steps": true, "provenance": {"validation": {}}}',
        b"[" * 20_000,
        b'{"provenance":' * 9_000,
    ],
)
def test_a_damaged_summary_is_one_line(content: bytes, tmp_path: Path) -> None:
    run = RunFolder(tmp_path)
    run.summary.write_bytes(content)
    with pytest.raises(InputError, match=r"summary\.json: .*; delete it") as refused:
        Finished.read(run)
    assert "\n" not in str(refused.value)
