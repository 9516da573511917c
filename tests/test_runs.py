"""The same command finds its run again; another one never writes into it unasked."""

from dataclasses import replace
from pathlib import Path

import pytest

from extrap_train.config import CategoryConfig, ModelConfig, SyntheticConfig, TrainConfig
from extrap_train.config import DatasetDepthConfig as Depth
from extrap_train.errors import InputError
from extrap_train.runs import open_run


@pytest.fixture
def config(tmp_path: Path) -> TrainConfig:
    return TrainConfig(
        category=CategoryConfig("hydrant", ["hydrant"]),
        data=SyntheticConfig(),
        depth=Depth(),
        model=ModelConfig(name="small"),
        output=str(tmp_path),
    )


def test_the_same_options_find_the_same_folder(config: TrainConfig, tmp_path: Path) -> None:
    first = open_run(config)
    assert open_run(config) == first
    assert (tmp_path / "train/hydrant/small/latest").resolve() == first.path.resolve()


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
