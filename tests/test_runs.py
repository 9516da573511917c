"""The same command finds its run again; another one never writes into it unasked."""

from dataclasses import replace
from pathlib import Path

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
)
from extrap_train.config import DatasetDepthConfig as Depth
from extrap_train.errors import InputError
from extrap_train.runs import _runs_of, existing_run, open_run, point_latest

_NAME_BEFORE = "seed0-ca916ebe"
"""Of the default run of a category, from when the last option was added that had to rename it."""


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


def test_the_same_options_find_the_same_folder(config: TrainConfig, tmp_path: Path) -> None:
    first = open_run(config)
    assert open_run(config) == first


def test_latest_moves_only_when_told(config: TrainConfig, tmp_path: Path) -> None:
    """A run whose data turn out to be unusable leaves the link at the last good one."""
    latest = tmp_path / "train/hydrant/small/latest"
    first = open_run(config)
    assert not latest.exists()
    point_latest(first)
    second = open_run(replace(config, seed=1))
    assert latest.resolve() == first.path.resolve()
    point_latest(second)
    assert latest.resolve() == second.path.resolve()


def test_other_options_are_another_run(config: TrainConfig) -> None:
    assert open_run(replace(config, seed=1)) != open_run(config)


def test_a_longer_training_is_the_same_run(config: TrainConfig) -> None:
    longer = replace(config, trainer=replace(config.trainer, steps=10 * config.trainer.steps))
    assert open_run(longer) == open_run(config)


def test_resuming_a_named_run_with_other_options_says_which(config: TrainConfig) -> None:
    open_run(replace(config, run="mine"))
    changed = replace(config, run="mine", model=replace(config.model, learning_rate=0.5))
    with pytest.raises(InputError, match=r"model\.learning_rate \(was 0\.0003, now 0\.5\)"):
        open_run(changed)
    open_run(replace(changed, resume=False))


def test_an_option_that_is_new_since_had_its_default(config: TrainConfig) -> None:
    saved = open_run(replace(config, run="mine")).path / "config.yaml"
    options = yaml.safe_load(saved.read_text())
    del options["trainer"]["power_averages"]
    saved.write_text(yaml.safe_dump(options))
    open_run(replace(config, run="mine"))
    saved.write_text(yaml.safe_dump(options))
    changed = replace(config.trainer, power_averages=True)
    with pytest.raises(InputError, match=r"power_averages \(was False, now True\)"):
        open_run(replace(config, run="mine", trainer=changed))


def test_what_a_model_recommends_is_part_of_the_run_as_far_as_it_is_used(
    config: TrainConfig,
) -> None:
    """Said by the command or by the model: the same run, and its file spells it out."""
    said = replace(config, sampler=SamplerOptions(steps=50))
    model = replace(config.model, sampler=SamplerConfig(steps=50))
    run = open_run(said)
    assert open_run(replace(config, model=model)) == run != open_run(config)
    assert open_run(replace(said, model=replace(model, sampler=SamplerConfig(steps=9)))) == run
    assert yaml.safe_load((run.path / "config.yaml").read_text())["sampler"]["steps"] == 50


def test_starting_over_forgets_the_finished_run(config: TrainConfig) -> None:
    """Else a new run that is killed early would be taken for the finished old one."""
    run = open_run(config)
    run.checkpoints.mkdir()
    (run.checkpoints / "step-00000001.ckpt").touch()
    run.summary.write_text("{}")
    open_run(config)
    assert run.summary.exists()
    open_run(replace(config, resume=False))
    assert not run.summary.exists()
    assert not run.checkpoints.exists()


def test_another_download_is_another_run(config: TrainConfig) -> None:
    one, two = (replace(config, data=Co3dConfig(root=root)) for root in ("one", "two"))
    assert open_run(one) != open_run(two)
    moved = replace(config, data=SyntheticConfig(root="elsewhere"))
    assert open_run(moved) == open_run(config)


@pytest.mark.parametrize("name", ["latest", "../other", "a/b", ".", "..", "a/", "a\\b", "/a"])
def test_a_run_has_the_name_of_a_folder(config: TrainConfig, name: str) -> None:
    """Else `resume=false` would remove what lies beside or above all runs."""
    precious = _runs_of(config) / "summary.json"
    precious.parent.mkdir(parents=True)
    precious.touch()
    for find in (open_run, existing_run):
        with pytest.raises(InputError, match="must be the name of a folder"):
            find(replace(config, run=name, resume=False))
    assert precious.exists()


def test_options_that_are_no_text_are_one_line(config: TrainConfig) -> None:
    saved = open_run(replace(config, run="mine")).path / "config.yaml"
    saved.write_bytes(b"\xff\xfe\xfa")
    with pytest.raises(InputError, match=r"unreadable.*choose run=NAME"):
        open_run(replace(config, run="mine"))


def test_an_option_that_changes_nothing_renames_no_run(config: TrainConfig) -> None:
    """Runs made before there was `model.joint_views` are found again; it makes another when set."""
    assert open_run(config).path.name == _NAME_BEFORE
    together = replace(config, model=replace(config.model, joint_views=2))
    assert open_run(together) != open_run(config)
    open_run(replace(config, run="mine"))
    with pytest.raises(InputError, match=r"model\.joint_views \(was 1, now 2\)"):
        open_run(replace(together, run="mine"))


def test_a_download_without_a_set_list_has_the_run_it_had(config: TrainConfig) -> None:
    download = Co3dConfig(root="co3d")
    assert open_run(replace(config, data=download)).path.name == "seed0-8e6e01a4"
    divided = replace(download, set_list="fewview_dev")
    assert open_run(replace(config, data=divided)) != open_run(replace(config, data=download))
