"""A small model and a batch that looks like a real one."""

import pytest
from batches import batch_of

from extrap_train.config import ModelConfig, UNetConfig
from extrap_train.views import PairBatch


@pytest.fixture
def batch() -> PairBatch:
    return batch_of(3)


@pytest.fixture
def config() -> ModelConfig:
    unet = UNetConfig(channels=[16, 32], attention_levels=[False, True], heads=2, token_width=16)
    return ModelConfig(name="tiny", image_size=32, octaves=2, unet=unet)
