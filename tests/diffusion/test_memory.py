"""The estimate counts what a step really holds, and running out of memory says what helps."""

from dataclasses import replace

import pytest
import torch

from extrap_train.config import ModelConfig, TrainerConfig, UNetConfig
from extrap_train.diffusion.memory import (
    LiveBytes,
    _step_bytes,
    advice_where_memory_ends,
    training_memory,
)
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.errors import InputError

_OPTIONS = TrainerConfig(batch_size=2, precision="32-true")


def test_live_bytes_see_storages_and_their_ends() -> None:
    with LiveBytes(iter([])) as live:
        one = torch.zeros(1000)
        view = one.view(10, 100)
        two = one + view.flatten()
        assert live.now == 8000
        del one, view
        assert live.now == 4000
        del two
        assert live.now == 0
        assert live.peak == 8000


def _model(config: ModelConfig) -> ExtrapolationModel:
    unet = UNetConfig(channels=[32, 64], attention_levels=[False, True], heads=2, token_width=16)
    return ExtrapolationModel(replace(config, unet=unet))


def test_a_fake_step_takes_what_a_real_one_takes(config: ModelConfig) -> None:
    model = _model(config)
    unet = model.unet.train()
    channels = unet.config["in_channels"]
    with LiveBytes(unet.parameters()) as live:
        noisy, token = torch.rand(2, channels, 16, 16), torch.rand(2, 1, 16)
        steps = torch.zeros(2, dtype=torch.long)
        unet(noisy, steps, token).sample.square().mean().backward()
    fake = _step_bytes(model.config, channels, _OPTIONS)
    assert fake == pytest.approx(live.peak, rel=0.05)
    less = _step_bytes(model.config, channels, replace(_OPTIONS, gradient_checkpointing=True))
    assert less < 0.9 * fake


def test_weights_moments_and_average_are_counted(config: ModelConfig) -> None:
    model = _model(config)
    trained = 4 * sum(x.numel() for x in model.parameters())
    needed = training_memory(model, _OPTIONS)
    assert (needed.weights, needed.optimizer, needed.average) == (trained, 2 * trained, trained)
    assert training_memory(model, replace(_OPTIONS, ema_decay=0.0)).average == 0
    assert "a step of batch 2" in str(needed)


@pytest.mark.parametrize(
    ("options", "helps"),
    [
        (_OPTIONS, "give trainer.gradient_checkpointing=true or trainer.batch_size=1"),
        (
            replace(_OPTIONS, gradient_checkpointing=True),
            r"give trainer.batch_size=1 or trainer.ema_decay=0",
        ),
        (
            replace(_OPTIONS, gradient_checkpointing=True, batch_size=1, ema_decay=0.0),
            "it takes a device with more memory",
        ),
    ],
)
def test_out_of_memory_names_two_options(options: TrainerConfig, helps: str) -> None:
    with pytest.raises(InputError, match=helps), advice_where_memory_ends(options):
        torch.empty(2**60)  # the CPU allocator's own error
    with pytest.raises(InputError, match=helps), advice_where_memory_ends(options):
        raise torch.OutOfMemoryError("CUDA out of memory")


def test_other_errors_pass() -> None:
    with pytest.raises(RuntimeError, match="shape"), advice_where_memory_ends(_OPTIONS):
        raise RuntimeError("shape")
