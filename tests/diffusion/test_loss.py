"""Weights of noise levels, by hand."""

from dataclasses import replace

import pytest
import torch

from extrap_train.config import ModelConfig
from extrap_train.diffusion.loss import diffusion_loss, snr_weights
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.diffusion.schedule import noise_schedule
from extrap_train.views import PairBatch


@pytest.mark.parametrize("prediction", ["epsilon", "v_prediction", "sample"])
def test_min_snr_is_one_weighting_of_the_clean_sample_whatever_is_predicted(
    config: ModelConfig, prediction: str
) -> None:
    """An error e of the clean sample is e·√SNR of ε and e·√(SNR + 1) of v."""
    schedule = noise_schedule(replace(config, prediction=prediction, zero_terminal_snr=False))
    timestep = torch.tensor([10, 400, 900])
    alpha = schedule.alphas_cumprod[timestep]
    snr = alpha / (1 - alpha)
    assert snr[0] > 5 > snr[1]
    squared = {"epsilon": snr, "v_prediction": snr + 1, "sample": torch.ones(3)}[prediction]
    expected = torch.tensor([5.0, float(snr[1]), float(snr[2])])
    torch.testing.assert_close(snr_weights(schedule, timestep, 5.0) * squared, expected)


def test_at_zero_terminal_snr_the_noisiest_step_weighs_nothing(config: ModelConfig) -> None:
    schedule = noise_schedule(replace(config, prediction="v_prediction"))
    assert snr_weights(schedule, torch.tensor([999]), 5.0).tolist() == [0.0]


def test_weights_change_the_loss_and_not_the_noise(config: ModelConfig, batch: PairBatch) -> None:
    """Under a bound below every level, all errors of the clean sample weigh that bound."""
    model = ExtrapolationModel(replace(config, prediction="sample", zero_terminal_snr=False))
    plain = diffusion_loss(model, batch, torch.Generator().manual_seed(3), 0.0)
    weighted = diffusion_loss(model, batch, torch.Generator().manual_seed(3), 0.0, 1e-9)
    assert float(weighted) == pytest.approx(1e-9 * float(plain), rel=1e-4)
