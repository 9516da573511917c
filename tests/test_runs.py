"""The same command finds its run again; another one never writes into it unasked."""

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
import yaml

from extrap_train.config import (
    CategoryConfig,
    Co3dConfig,
    FlowMatcherConfig,
    ModelConfig,
    SamplerConfig,
    SamplerOptions,
    SyntheticConfig,
    TrainConfig,
    ValidationConfig,
)
from extrap_train.config import DatasetDepthConfig as Depth
from extrap_train.errors import InputError
from extrap_train.runs import (
    Finished,
    RunFolder,
    _runs_of,
    existing_run,
    newest_run,
    point_latest,
    require_same_options,
    run_folder,
    run_identity,
    short_name,
)
from extrap_train.store.manifest import Conflict, Manifest, Split, claim, read_manifest
from extrap_train.tasks.category import _opened
from extrap_train.tasks.scene_inputs import result_folder
from extrap_train.terminal import terminal

_SPLIT = Split("synthetic", ("0001",), ("0000",))


def opened(config: TrainConfig, key: str = "key") -> RunFolder:
    """The run, on the data of this key, as `task=category` opens it."""
    folder = run_folder(config)
    require_same_options(folder, config)
    inputs = {"data of hydrant": key}
    manifest = Manifest.of(run_identity(config), inputs, {"hydrant": _SPLIT})
    with _opened(folder, config, manifest, terminal(quiet=True)):
        return folder


def begun(config: TrainConfig) -> RunFolder:
    """The run with its first checkpoint."""
    run = opened(config)
    run.checkpoints.mkdir(exist_ok=True)
    (run.checkpoints / "step-00000003.ckpt").touch()  # damaged, and passed over
    return run


@pytest.fixture
def config(tmp_path: Path) -> TrainConfig:
    return TrainConfig(
        category=CategoryConfig("hydrant", ["hydrant"]),
        data=SyntheticConfig(),
        depth=Depth(),
        matcher=FlowMatcherConfig(),
        model=ModelConfig(name="small"),
        output=str(tmp_path),
    )


@pytest.mark.parametrize("name", ["x" * 240, "x" * 151, "ü" * 76])
def test_a_name_too_long_for_the_files_beside_it_is_refused(config: TrainConfig, name: str) -> None:
    with pytest.raises(InputError, match=r"of at most 150.*run=NAME"):
        run_folder(replace(config, run=name))
    with pytest.raises(InputError, match=r"of at most 150.*run=NAME"):
        result_folder(replace(config, task="view"), name)


@pytest.mark.parametrize("name", ["x" * 150, "ü" * 75])
def test_the_longest_name_leaves_room_for_the_files_beside_it(tmp_path: Path, name: str) -> None:
    folder = tmp_path / short_name(name)
    for _ in range(2):
        with claim(folder, Manifest.of({}), resume=False) as claimed:
            claimed.begin()
    assert folder.is_dir()


def test_the_same_options_find_the_same_folder(config: TrainConfig, tmp_path: Path) -> None:
    first = opened(config)
    assert opened(config) == first


def test_latest_is_the_run_that_was_opened_last(config: TrainConfig, tmp_path: Path) -> None:
    latest = tmp_path / "train/hydrant/small/latest"
    first = run_folder(config)
    assert not latest.exists()
    opened(config)
    assert latest.resolve() == first.path.resolve()
    second = opened(replace(config, seed=1))
    assert latest.resolve() == second.path.resolve()
    point_latest(first)
    assert latest.resolve() == first.path.resolve()


def test_a_folder_called_latest_is_not_replaced(config: TrainConfig, tmp_path: Path) -> None:
    latest = tmp_path / "train/hydrant/small/latest"
    latest.mkdir(parents=True)
    with pytest.raises(InputError, match="latest: is a folder"):
        opened(config)
    assert latest.is_dir()


def test_other_options_are_another_run(config: TrainConfig) -> None:
    assert opened(replace(config, seed=1)) != opened(config)


def test_a_longer_training_is_the_same_run(config: TrainConfig) -> None:
    longer = replace(config, trainer=replace(config.trainer, steps=10 * config.trainer.steps))
    assert opened(longer) == opened(config)


def test_resuming_a_named_run_with_other_options_says_which(config: TrainConfig) -> None:
    begun(replace(config, run="mine"))
    changed = replace(config, run="mine", model=replace(config.model, learning_rate=0.5))
    with pytest.raises(InputError, match=r"model\.learning_rate \(was 0\.0003, now 0\.5\)"):
        opened(changed)
    opened(replace(changed, resume=False))


def test_what_a_model_recommends_is_part_of_the_run_as_far_as_it_is_used(
    config: TrainConfig,
) -> None:
    """Said by the command or by the model: the same run, and its file spells it out."""
    said = replace(config, sampler=SamplerOptions(steps=50))
    model = replace(config.model, sampler=SamplerConfig(steps=50))
    run = opened(said)
    assert opened(replace(config, model=model)) == run != opened(config)
    assert opened(replace(said, model=replace(model, sampler=SamplerConfig(steps=9)))) == run
    assert yaml.safe_load((run.path / "config.yaml").read_text())["sampler"]["steps"] == 50


_OPENED = {"config.yaml", "manifest.json", ".opened.json"}


def _summary(steps: int) -> str:
    measured = {"validation": asdict(ValidationConfig())}
    return json.dumps({"steps": steps, "provenance": measured})


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


def _content(run: RunFolder) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in run.path.rglob("*") if path.is_file()}


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


def _of_steps(config: TrainConfig, steps: int, run: str | None = None) -> TrainConfig:
    return replace(config, run=run, trainer=replace(config.trainer, steps=steps))


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
@pytest.mark.parametrize("steps", [19, 21, 1240])
def test_a_sweeps_job_takes_no_named_run_of_another_length(config: TrainConfig, steps: int) -> None:
    run = opened(_of_steps(config, 20, "mine"))
    run.summary.write_text(_summary(steps))
    before = _content(run)
    with pytest.raises(Conflict, match=rf"trainer\.steps .*{steps}"):
        opened(_of_steps(config, 20, "mine"))
    assert _content(run) == before


def test_a_single_command_does_not_share_a_sweeps_run(
    config: TrainConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    alone = opened(config)
    monkeypatch.setattr("extrap_train.runs.in_sweep", lambda: True)
    assert opened(config) != alone


def test_another_download_is_another_run(config: TrainConfig) -> None:
    one, two = (replace(config, data=Co3dConfig(root=root)) for root in ("one", "two"))
    assert opened(one) != opened(two)
    moved = replace(config, data=SyntheticConfig(root="elsewhere"))
    assert opened(moved) == opened(config)


def test_the_same_download_is_the_same_run_however_its_path_is_spelled(
    config: TrainConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "co3d").mkdir()
    (tmp_path / "link").symlink_to("co3d")
    monkeypatch.chdir(tmp_path)
    spelled = ["co3d", "co3d/", "link", f"{tmp_path}/link/../co3d", str(tmp_path / "co3d")]
    for name in (None, "mine"):
        runs = {
            begun(replace(config, run=name, data=Co3dConfig(root=root))).path for root in spelled
        }
        assert len(runs) == 1
    saved = runs.pop() / "config.yaml"
    assert yaml.safe_load(saved.read_text())["data"]["root"] == str(tmp_path / "co3d")


def test_a_start_is_a_path_where_there_is_one(
    config: TrainConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def start(value: str) -> RunFolder:
        return opened(replace(config, model=replace(config.model, start=value)))

    monkeypatch.chdir(tmp_path)
    named = start("base")
    for name in ("base", "mine"):
        (tmp_path / name).mkdir()
    assert start("mine") == start("./mine/")
    assert start("base") == named != start("./base/")


@pytest.mark.parametrize(
    "option",
    [
        {"workers": 2},
        {"accelerator": "cpu"},
        {"checkpoint_every": 40},
        {"validate_every": 800},
        {"steps": 9},
    ],
)
def test_what_changes_nothing_learnt_is_the_same_run(
    config: TrainConfig, option: dict[str, Any]
) -> None:
    changed = replace(config, trainer=replace(config.trainer, **option))
    assert opened(changed) == opened(config)
    begun(replace(config, run="mine"))
    opened(replace(changed, run="mine"))


@pytest.mark.parametrize("name", ["latest", "../other", "a/b", ".", "..", "a/", "a\\b", "/a"])
def test_a_run_has_the_name_of_a_folder(config: TrainConfig, name: str) -> None:
    """Else `resume=false` would remove what lies beside or above all runs."""
    precious = _runs_of(config) / "summary.json"
    precious.parent.mkdir(parents=True)
    precious.touch()
    for find in (opened, existing_run):
        with pytest.raises(InputError, match="must be the name of a folder"):
            find(replace(config, run=name, resume=False))
    assert precious.exists()


@pytest.mark.parametrize(
    "content",
    [
        b"\xff\xfe\xfa",
        b"a: &a [*a]",
        b"a: &a [x, x]\nb: &b [*a, *a]\nc: [*b, *b]",
        b"[" * 20_000,
        b"- a",
        b"a: 1\n" * 90_000,
    ],
)
def test_options_that_are_no_options_are_one_line(config: TrainConfig, content: bytes) -> None:
    saved = begun(replace(config, run="mine")).options
    saved.write_bytes(content)
    with pytest.raises(InputError, match=r"config\.yaml: unreadable .*run=NAME"):
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


def test_a_set_list_makes_another_run(config: TrainConfig) -> None:
    download = Co3dConfig(root="/data/co3d")
    divided = replace(download, set_list="fewview_dev")
    assert opened(replace(config, data=divided)) != opened(replace(config, data=download))
