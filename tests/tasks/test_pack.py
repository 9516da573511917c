"""`task=pack`: the model lies under its packaged name and comes back."""

from pathlib import Path

import torch

from extrap_train.config import (
    CategoryConfig,
    DatasetDepthConfig,
    FlowMatcherConfig,
    ModelConfig,
    SyntheticConfig,
    TrainConfig,
)
from extrap_train.diffusion.checkpoint import load_model
from extrap_train.diffusion.packaged import packaged_weights
from extrap_train.tasks.pack import run


def test_the_base_itself_loses_nothing(tmp_path: Path) -> None:
    run(
        TrainConfig(
            category=CategoryConfig("cup", ["cup"]),
            data=SyntheticConfig(),
            depth=DatasetDepthConfig(),
            matcher=FlowMatcherConfig(),
            model=ModelConfig(name="small"),
            weights="base",
            output=str(tmp_path),
        )
    )
    base = load_model(packaged_weights("base")).state_dict()
    packed = load_model(tmp_path / "packed" / "ours-cup").state_dict()
    assert all(torch.equal(packed[name], value) for name, value in base.items())
