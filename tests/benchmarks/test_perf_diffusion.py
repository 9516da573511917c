"""What is timed against each other computes the same, but for precision."""

import copy
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from diffusers.models.attention_processor import Attention
from torch import nn

from benchmarks.perf import diffusion_case
from benchmarks.perf.average_timing import compare_averages
from benchmarks.perf.diffusion_case import (
    batch_of,
    configuration,
    forward_flops,
    optimised,
    plain,
)
from benchmarks.perf.end_to_end_timing import compare_steps, prepared_captures
from benchmarks.perf.sample_timing import plain_sampling, sampling
from benchmarks.perf.train_timing import training_step
from extrap_train.config import ModelConfig
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.views import PairBatch

_CPU = torch.device("cpu")


@pytest.fixture(scope="module", autouse=True)
def _small() -> Iterator[None]:
    """Views of 64 pixels."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(diffusion_case, "IMAGE_SIZE", 64)
        yield


@pytest.fixture(scope="module")
def config() -> ModelConfig:
    return configuration(32)


@pytest.fixture(scope="module")
def model(config: ModelConfig) -> ExtrapolationModel:
    return optimised(config, _CPU).eval()


@pytest.fixture(scope="module")
def batch() -> PairBatch:
    return batch_of(1, _CPU)


def test_the_timed_model_is_arranged_and_the_plain_one_is_not(model: ExtrapolationModel) -> None:
    """The frozen networks, too, which copies of a model share."""
    copied = plain(model)
    for part, name in (("unet", "conv_in"), ("vae", "encoder.conv_in")):
        weights = [m.parts()[part].get_submodule(name).weight for m in (model, copied)]
        last = [x.is_contiguous(memory_format=torch.channels_last) for x in weights]
        assert last == [True, False]
        assert torch.equal(*weights)


def test_both_steps_have_one_loss(model: ExtrapolationModel, batch: PairBatch) -> None:
    """Each as it is timed: fused, in mixed precision and channels last, against plain float32."""
    theirs = training_step(plain(model), lambda: batch, optimised=False)()
    ours = training_step(copy.deepcopy(model), lambda: batch, optimised=True)()
    torch.testing.assert_close(ours, theirs, atol=0.02, rtol=0.02)


def test_both_samplers_generate_one_picture(model: ExtrapolationModel, batch: PairBatch) -> None:
    theirs = plain_sampling(plain(model), batch)()
    ours = sampling(model, batch)()
    assert float((ours - theirs).abs().mean()) < 0.02


@pytest.mark.slow
def test_both_steps_from_stored_frames_to_the_average_have_one_loss(tmp_path: Path) -> None:
    """From the same examples; on cached features and the compiled warp, and on plain ones."""
    configs = [configuration(32, family) for family in ("ours", "zeronvs")]
    data = prepared_captures(tmp_path, configs[0].warp_size)
    for config in configs:
        assert compare_steps(config, data, _CPU, repeats=1).max_abs_diff < 0.02


def test_both_averages_are_one() -> None:
    assert compare_averages(32, _CPU, repeats=1).max_abs_diff < 1e-6


def test_operations_are_those_of_the_layers(config: ModelConfig) -> None:
    """Every convolution, matrix and attention by its own formula; a product and a sum are two."""
    with torch.device("meta"):
        unet = ExtrapolationModel(config).unet
    counted: list[int] = []

    def convolution(layer: nn.Conv2d, _: Any, __: Any, out: torch.Tensor) -> None:
        counted.append(2 * layer.weight[0].numel() * out.numel())

    def matrix(layer: nn.Linear, _: Any, __: Any, out: torch.Tensor) -> None:
        counted.append(2 * layer.in_features * out.numel())

    def attention(layer: Attention, given: Any, named: Any, _: Any) -> None:
        token = named.get("encoder_hidden_states")
        asked = given[0].shape[1]
        known = asked if token is None else token.shape[1]
        counted.append(2 * 2 * asked * known * layer.inner_dim)

    kinds: dict[type, Any] = {nn.Conv2d: convolution, nn.Linear: matrix, Attention: attention}
    for layer in unet.modules():
        if type(layer) in kinds:
            layer.register_forward_hook(kinds[type(layer)], with_kwargs=True)
    size, width = unet.config["sample_size"], config.unet.token_width
    noisy = torch.empty(1, unet.config["in_channels"], size, size, device="meta")
    step = torch.zeros(1, dtype=torch.long, device="meta")
    unet(noisy, step, torch.empty(1, 1, width, device="meta"))
    assert len(counted) > 100
    assert forward_flops(config) == sum(counted)
