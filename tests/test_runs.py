"""The same command finds its run again; another one never writes into it unasked."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml
from opened_runs import begun, hydrant_config, opened

from extrap_train.config import (
    Co3dConfig,
    SamplerConfig,
    SamplerOptions,
    SyntheticConfig,
    TrainConfig,
)
from extrap_train.errors import InputError
from extrap_train.runs import (
    RunFolder,
    _runs_of,
    existing_run,
    point_latest,
    run_folder,
    short_name,
)
from extrap_train.store.manifest import Manifest, claim
from extrap_train.tasks.scene_inputs import result_folder


@pytest.fixture
def config(tmp_path: Path) -> TrainConfig:
    return hydrant_config(tmp_path)


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


def test_a_set_list_makes_another_run(config: TrainConfig) -> None:
    download = Co3dConfig(root="/data/co3d")
    divided = replace(download, set_list="fewview_dev")
    assert opened(replace(config, data=divided)) != opened(replace(config, data=download))
