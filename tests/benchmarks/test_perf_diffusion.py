"""What is timed against each other computes the same, but for precision."""

import pytest
import torch

from benchmarks.perf.diffusion_case import (
    Size,
    batch_of,
    configuration,
    forward_flops,
    optimised,
    plain,
)
from benchmarks.perf.sample import plain_sampling, sampling
from benchmarks.perf.train import training_step
from extrap_train.config import ModelConfig
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.views import PairBatch

_CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def config() -> ModelConfig:
    return configuration(Size("tiny", 32))


@pytest.fixture(scope="module")
def model(config: ModelConfig) -> ExtrapolationModel:
    return optimised(config, _CPU).eval()


@pytest.fixture(scope="module")
def batch() -> PairBatch:
    return batch_of(1, _CPU)


def test_both_steps_have_one_loss(model: ExtrapolationModel, batch: PairBatch) -> None:
    theirs = training_step(plain(model), batch, optimised=False)()
    ours = training_step(plain(model), batch, optimised=True)()
    torch.testing.assert_close(ours, theirs, atol=0.02, rtol=0.02)


def test_both_samplers_paint_one_picture(model: ExtrapolationModel, batch: PairBatch) -> None:
    theirs = plain_sampling(plain(model), batch, 2)()
    ours = sampling(model, batch, 2)()
    assert float((ours - theirs).abs().mean()) < 0.02


def test_operations_are_those_of_the_layers(config: ModelConfig) -> None:
    """The first layer alone: 3 × 3 products of every input with every output channel, twice."""
    channels = ExtrapolationModel(config).unet.config["in_channels"]
    first = 2 * 9 * channels * 32 * 32 * 32
    assert forward_flops(config) > 20 * first
