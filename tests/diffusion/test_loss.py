"""Weights of noise levels and of what is known, by hand."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import pytest
import torch

from extrap_train.config import ModelConfig
from extrap_train.diffusion.conditioning import Conditioning
from extrap_train.diffusion.loss import Anchor, diffusion_loss, prediction_errors, snr_weights
from extrap_train.diffusion.model import ExtrapolationModel, noise_schedule
from extrap_train.diffusion.step_noise import StepNoise
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


@pytest.mark.parametrize("prediction", ["v_prediction", "sample"])
def test_at_zero_terminal_snr_no_step_is_without_weight(
    config: ModelConfig, prediction: str
) -> None:
    """Sampling starts at the noisiest step: v has its even weight there, the sample as much."""
    schedule = noise_schedule(replace(config, prediction=prediction))
    weights = snr_weights(schedule, torch.arange(1000), 5.0)
    assert float(schedule.alphas_cumprod[999]) == pytest.approx(0, abs=1e-6)
    assert float(weights[999]) == pytest.approx(1, abs=1e-5)
    per_sample = weights * ((1 / (1 - schedule.alphas_cumprod)) if prediction[0] == "v" else 1)
    assert float(per_sample.min()) == pytest.approx(1, abs=1e-5)
    assert float(per_sample.max()) == pytest.approx(5)


def test_a_weighed_model_learns_at_the_noisiest_step(config: ModelConfig, batch: PairBatch) -> None:
    model = ExtrapolationModel(config)
    torch.nn.init.normal_(model.unet.conv_out.weight, std=0.1)
    conditioning = model.condition(batch)
    target = model.encode_target(batch, conditioning)
    noisiest = torch.full((len(target),), 999)
    errors = prediction_errors(model, target, torch.ones_like(target), noisiest, conditioning)
    (errors * snr_weights(model.schedule, noisiest, 5.0)).mean().backward()
    assert model.unet.conv_out.weight.grad is not None
    assert model.unet.conv_out.weight.grad.abs().max() > 0


def test_weights_change_the_loss_and_not_the_noise(config: ModelConfig, batch: PairBatch) -> None:
    """Under a bound below every level, all errors of the clean sample weigh that bound."""
    model = ExtrapolationModel(replace(config, prediction="sample", zero_terminal_snr=False))
    plain = diffusion_loss(model, batch, StepNoise(torch.Generator().manual_seed(3)), 0.0)
    weighted = diffusion_loss(model, batch, StepNoise(torch.Generator().manual_seed(3)), 0.0, 1e-9)
    assert float(weighted) == pytest.approx(1e-9 * float(plain), rel=1e-4)


@pytest.mark.parametrize("prediction", ["epsilon", "v_prediction", "sample"])
def test_an_anchored_model_learns_the_truth_where_it_is_known_and_itself_elsewhere(
    config: ModelConfig, batch: PairBatch, prediction: str
) -> None:
    """The left half is known: the errors there are against the truth, on the right against what
    the model said before its last layer was changed.
    """
    model = ExtrapolationModel(replace(config, prediction=prediction, zero_terminal_snr=False))
    torch.nn.init.normal_(model.unet.conv_out.weight, std=0.1)
    bias = model.unet.conv_out.bias
    assert bias is not None

    @contextmanager
    def unchanged() -> Iterator[None]:
        bias.data -= 0.5
        yield
        bias.data += 0.5

    bias.data += 0.5
    known = torch.zeros(3, config.image_size, config.image_size)
    known[..., : config.image_size // 2] = 1
    conditioning = model.condition(batch)
    target = model.encode_target(batch, conditioning)
    noise, level = torch.ones_like(target), torch.tensor([100, 500, 900])
    told = (model, target, noise, level, conditioning)
    everywhere = Anchor(torch.ones_like(known), unchanged)
    nowhere = Anchor(torch.zeros_like(known), unchanged)
    with torch.no_grad():
        plain, half = prediction_errors(*told), prediction_errors(*told, Anchor(known, unchanged))
        torch.testing.assert_close(prediction_errors(*told, everywhere), plain)
        moved = torch.full((3,), 0.25)  # of every channel by a half, squared
        torch.testing.assert_close(prediction_errors(*told, nowhere), moved, atol=1e-4, rtol=0)
        left = _left_half_error(*told)
        torch.testing.assert_close(half, left / 2 + moved / 2, atol=1e-4, rtol=1e-4)


def _left_half_error(model, target, noise, level, conditioning) -> torch.Tensor:
    noisy = model.schedule.add_noise(target, noise, level)
    wanted = {
        "epsilon": noise,
        "sample": target,
        "v_prediction": model.schedule.get_velocity(target, noise, level),
    }[model.config.prediction]
    error = (model(noisy, level, conditioning) - wanted).square()
    return error[..., : error.shape[-1] // 2].mean((1, 2, 3))


@pytest.mark.parametrize(("share", "is_dropped"), [(0.0, False), (1.0, True)])
def test_the_condition_is_dropped_for_the_share_that_is_asked_for(
    config: ModelConfig,
    batch: PairBatch,
    monkeypatch: pytest.MonkeyPatch,
    share: float,
    is_dropped: bool,
) -> None:
    seen, zeroed = [], Conditioning.zeroed

    def record(self: Conditioning, dropped: torch.Tensor) -> Conditioning:
        seen.append(dropped)
        return zeroed(self, dropped)

    monkeypatch.setattr(Conditioning, "zeroed", record)
    diffusion_loss(
        ExtrapolationModel(config), batch, StepNoise(torch.Generator().manual_seed(0)), share
    )
    assert [bool(each) for each in seen[0]] == [is_dropped] * len(batch.image)
