"""`task=pack`: the model lies under its packaged name and comes back."""

from pathlib import Path

import pytest
import torch

from extrap_train.config import (
    CategoryConfig,
    DatasetDepthConfig,
    FlowMatcherConfig,
    ModelConfig,
    SyntheticConfig,
    TrainConfig,
)
from extrap_train.diffusion.model_files import load_model
from extrap_train.diffusion.packaged import packaged_weights
from extrap_train.store.manifest import Conflict
from extrap_train.tasks.pack import run


def _config(output: Path, weights: str, **options: bool) -> TrainConfig:
    return TrainConfig(
        category=CategoryConfig("cup", ["cup"]),
        data=SyntheticConfig(),
        depth=DatasetDepthConfig(),
        matcher=FlowMatcherConfig(),
        model=ModelConfig(name="small"),
        weights=weights,
        output=str(output),
        **options,
    )


def test_the_base_itself_loses_nothing(tmp_path: Path) -> None:
    run(_config(tmp_path, "base"))
    base = load_model(packaged_weights("base")).state_dict()
    packed = load_model(tmp_path / "packed" / "ours-cup").state_dict()
    assert all(torch.equal(packed[name], value) for name, value in base.items())


def test_another_model_takes_the_place_only_where_it_is_told_to(tmp_path: Path) -> None:
    file = tmp_path / "packed" / "ours-cup" / "difference.safetensors"
    assert not run(_config(tmp_path, "base")).is_reused
    before, written = file.read_bytes(), file.stat()
    assert run(_config(tmp_path, "base")).is_reused
    assert file.stat() == written
    with pytest.raises(Conflict, match=r"ours-cup.*weights.*output=.*resume=false"):
        run(_config(tmp_path, "ours-apple"))
    assert file.read_bytes() == before
    assert not run(_config(tmp_path, "ours-apple", resume=False)).is_reused
    assert file.read_bytes() != before
