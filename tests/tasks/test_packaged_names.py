"""A packaged model's name means that model; a folder called like it must be given as a path."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from benchmarks.methods.diffusion import Diffusion
from extrap_train.config import (
    CategoryConfig,
    DatasetDepthConfig,
    FlowMatcherConfig,
    ModelConfig,
    SyntheticConfig,
    TrainConfig,
    packaged_names,
    resolve_paths,
)
from extrap_train.config.checks import notes
from extrap_train.diffusion.model_files import initial_model, load_model, save_model, saved_config
from extrap_train.diffusion.packaged import packaged_weights
from extrap_train.runs import run_manifest
from extrap_train.tasks.scene_model import UsedWeights, model_of, open_model


@pytest.fixture
def config(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> TrainConfig:
    """In a working folder where everything is called like a packaged model."""
    for name in packaged_names():
        (tmp_path / name).mkdir()
        (tmp_path / name / "thesis.txt").write_text("years of work")
    monkeypatch.chdir(tmp_path)
    return TrainConfig(
        category=CategoryConfig("cup", ["cup"]),
        data=SyntheticConfig(),
        depth=DatasetDepthConfig(),
        matcher=FlowMatcherConfig(),
        model=replace(saved_config(packaged_weights("base")), name="small", start="base"),
    )


def _first_weight(folder: Path) -> torch.Tensor:
    return load_model(folder).unet.conv_in.weight


@pytest.mark.parametrize("weights", [None, "base", "ours-cup", "zeronvs"])
def test_the_packaged_model_is_used(config: TrainConfig, weights: str | None) -> None:
    used = UsedWeights.of(replace(config, weights=weights))
    assert (used.name, used.is_packaged) == (weights or "ours-cup", True)
    assert used.steps
    packaged = packaged_weights(used.name)
    assert torch.equal(open_model(used.name).unet.conv_in.weight, _first_weight(packaged))


def test_training_starts_from_the_packaged_model(config: TrainConfig) -> None:
    assert resolve_paths(config).model.start == "base"
    started = initial_model(config.model).unet.conv_in.weight
    assert torch.equal(started, _first_weight(packaged_weights("base")))
    assert (
        "model.start"
        not in run_manifest(replace(config, category=CategoryConfig("cup", [])), []).inputs
    )


def test_a_row_takes_the_packaged_model(config: TrainConfig) -> None:
    (file, *_) = Diffusion(weights="base").weight_files("cup")
    assert packaged_weights("base") in file.parents


def test_a_path_is_a_folder_of_that_name(config: TrainConfig, tmp_path: Path) -> None:
    save_model(load_model(packaged_weights("ours-cup")), tmp_path / "base")
    used = UsedWeights.of(replace(config, weights="./base"))
    assert (used.name, used.is_packaged) == (str(tmp_path / "base"), False)
    expected = _first_weight(packaged_weights("ours-cup"))
    model = model_of(replace(config, model=ModelConfig(name="small")), used.name)
    assert torch.equal(model.unet.conv_in.weight, expected)
    assert resolve_paths(replace(config.model, start="./base")).start == str(tmp_path / "base")


def test_a_folder_that_is_not_meant_is_said(config: TrainConfig) -> None:
    assert [note.partition(":")[0] for note in notes(replace(config, weights="base"))] == [
        "weights=base",
        "model.start=base",
    ]
    other = replace(config, weights="./base", model=replace(config.model, start=None))
    assert notes(other) == []
