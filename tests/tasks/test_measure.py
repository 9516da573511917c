"""A finished run is measured on the data that it was trained on, or not at all."""

import json
from pathlib import Path

import pytest
from orbits import capture, even, ring
from prepared import prepared_captures

from extrap_train.config import (
    CategoryConfig,
    Co3dConfig,
    DatasetDepthConfig,
    FlowMatcherConfig,
    ModelConfig,
    TrainConfig,
)
from extrap_train.data.prepared import PreparedData
from extrap_train.errors import InputError
from extrap_train.runs import RunFolder, trained_on
from extrap_train.store.manifest import MANIFEST, Manifest
from extrap_train.store.records import write_record
from extrap_train.tasks import validate
from extrap_train.tasks.training_data import Prepare


def _prepared(folder: Path, test_names: set[str]) -> PreparedData:
    captures = [capture(ring(even(24)), f"{index:04d}") for index in range(3)]
    return prepared_captures(folder, captures, test_names)


@pytest.fixture
def prepare(tmp_path: Path) -> Prepare:
    """Another sequence is held out today."""
    today = [_prepared(tmp_path / "today", {"0001"})]
    return lambda _: today


@pytest.fixture
def run(tmp_path: Path, config: TrainConfig) -> RunFolder:
    """Finished, as far as its folder says; its model is not needed to refuse to measure it."""
    run = RunFolder(tmp_path / "out/train/cup/small/mine")
    run.path.mkdir(parents=True)
    run.summary.write_text(json.dumps({"steps": 3}))
    inputs, split = trained_on(config, [_prepared(tmp_path / "cup", {"0000"})])
    write_record(run.path / MANIFEST, Manifest.of({}, inputs, split))
    return run


@pytest.fixture
def config(tmp_path: Path) -> TrainConfig:
    return TrainConfig(
        category=CategoryConfig("cup", ["cup"]),
        data=Co3dConfig(root=str(tmp_path)),
        depth=DatasetDepthConfig(),
        matcher=FlowMatcherConfig(),
        model=ModelConfig(name="small"),
        output=str(tmp_path / "out"),
        run="mine",
    )


def test_a_run_that_has_seen_what_is_held_out_today_is_not_measured(
    run: RunFolder, config: TrainConfig, prepare: Prepare
) -> None:
    before = sorted(run.path.rglob("*"))
    with pytest.raises(InputError, match=r"split of cup \(2 .* 0000\).* or measure another"):
        validate.run(config, prepare)
    assert sorted(run.path.rglob("*")) == before


def test_a_run_that_does_not_say_what_it_has_seen_is_not_measured(
    run: RunFolder, config: TrainConfig, prepare: Prepare
) -> None:
    (run.path / MANIFEST).unlink()
    with pytest.raises(InputError, match=r"manifest\.json: .*run=NAME"):
        validate.run(config, prepare)
