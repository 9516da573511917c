"""Sampling inverts the noise that training adds, one generator per view, guidance in one pass."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor, nn

from extrap_train.config import ModelConfig, SamplerConfig
from extrap_train.diffusion.conditioning import Conditioning, filled_warp
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.diffusion.sampler import sample_views, view_generator
from extrap_train.diffusion.schedule import even_in_log_snr, noise_schedule, solver_of
from extrap_train.views import PairBatch


class Oracle(nn.Module):
    """Knows the image: predicts what the true latent demands at every step."""

    def __init__(self, model: ExtrapolationModel, batch: PairBatch) -> None:
        super().__init__()
        self.model, self.schedule = model, model.schedule
        self.target = model.encode_target(batch.image, model.condition(batch))
        self.condition, self.decode_target = model.condition, model.decode_target

    def forward(self, noisy: Tensor, timestep: Tensor, conditioning: Conditioning) -> Tensor:
        alpha = self.schedule.alphas_cumprod[timestep][:, None, None, None]
        kind = self.model.config.prediction
        if kind == "sample":
            return self.target
        if kind == "v_prediction":
            noise = (noisy - alpha.sqrt() * self.target) / (1 - alpha).sqrt()
            return alpha.sqrt() * noise - (1 - alpha).sqrt() * self.target
        return (noisy - alpha.sqrt() * self.target) / (1 - alpha).sqrt()


@pytest.mark.parametrize(
    ("prediction", "zero_snr"),
    [("v_prediction", True), ("v_prediction", False), ("sample", True), ("epsilon", False)],
)
@pytest.mark.parametrize("solver", ["ddim", "dpmpp", "unipc"])
@pytest.mark.parametrize("residual", [True, False])
def test_an_oracle_denoiser_returns_the_truth(
    config: ModelConfig,
    batch: PairBatch,
    prediction: str,
    zero_snr: bool,
    residual: bool,
    solver: str,
) -> None:
    chosen = replace(config, prediction=prediction, zero_terminal_snr=zero_snr, residual=residual)
    oracle = Oracle(ExtrapolationModel(chosen), batch)
    generators = [view_generator(0, str(i)) for i in range(3)]
    image = sample_views(oracle, batch, SamplerConfig(solver, steps=20), generators)
    tolerance = 1e-4 if zero_snr else 0.05  # without zero SNR the first step's noise stays a little
    assert (image - batch.image).abs().max() < tolerance


def _randomised(config: ModelConfig) -> ExtrapolationModel:
    torch.manual_seed(0)
    model = ExtrapolationModel(config)
    nn.init.normal_(model.unet.conv_out.weight, std=0.05)
    return model.eval()


@pytest.mark.parametrize("eta", [0.0, 1.0])
def test_a_view_does_not_depend_on_its_batch(
    config: ModelConfig, batch: PairBatch, eta: float
) -> None:
    model = _randomised(config)
    options = SamplerConfig(steps=4, eta=eta, guidance=2.0)
    together = sample_views(model, batch, options, [view_generator(1, name) for name in "abc"])
    alone = sample_views(model, batch, options, [view_generator(1, name) for name in "xbz"])
    torch.testing.assert_close(together[1], alone[1], atol=1e-5, rtol=0)
    assert (together[0] - alone[0]).abs().max() > 1e-3, "another name is another noise"


def test_guidance_of_one_is_the_conditional_prediction(
    config: ModelConfig, batch: PairBatch
) -> None:
    model = _randomised(config)
    names = [view_generator(2, name) for name in "abc"]
    plain = sample_views(model, batch, SamplerConfig(steps=2, guidance=1.0), names)
    names = [view_generator(2, name) for name in "abc"]
    near = sample_views(model, batch, SamplerConfig(steps=2, guidance=1.0 + 1e-6), names)
    torch.testing.assert_close(plain, near, atol=1e-4, rtol=0)


def test_an_untrained_model_returns_the_filled_warp(config: ModelConfig, batch: PairBatch) -> None:
    """Its last layer is zero and it denoises a residual: at v = 0 the mean of what it paints is its
    base.
    """
    model = ExtrapolationModel(replace(config, prediction="sample")).eval()
    generators = [view_generator(0, name) for name in "abc"]
    image = sample_views(model, batch, SamplerConfig(steps=5), generators)
    assert batch.warp is not None
    torch.testing.assert_close(image, filled_warp(batch.warp).clamp(0, 1), atol=1e-5, rtol=0)


class GaussianDenoiser(nn.Module):
    """The exact v of latents that are normal with spread 0.5: its probability flow has a closed
    form.
    """

    spread = 0.5

    def __init__(self, model: ExtrapolationModel) -> None:
        super().__init__()
        self.model, self.schedule = model, model.schedule
        self.condition = model.condition
        self.decode_target = lambda latent, _: nn.functional.pixel_shuffle(latent, 2)

    def spread_at(self, alpha: Tensor) -> Tensor:
        return (alpha * self.spread**2 + 1 - alpha).sqrt()

    def forward(self, noisy: Tensor, timestep: Tensor, conditioning: Conditioning) -> Tensor:
        alpha = self.schedule.alphas_cumprod[timestep][:, None, None, None]
        gain = (alpha * (1 - alpha)).sqrt() * (1 - self.spread**2)
        return gain * noisy / self.spread_at(alpha) ** 2


@pytest.mark.parametrize("zero_snr", [False, True])
@pytest.mark.parametrize("solver", ["dpmpp", "unipc"])
def test_second_order_solvers_follow_the_flow_in_fewer_steps(
    config: ModelConfig, batch: PairBatch, solver: str, zero_snr: bool
) -> None:
    """Against the exact solution of the flow: noise scaled by the spreads' ratio."""
    chosen = replace(config, prediction="v_prediction", zero_terminal_snr=zero_snr)
    denoiser = GaussianDenoiser(ExtrapolationModel(chosen))
    names = "abc"
    drawn = torch.stack([torch.randn(12, 16, 16, generator=view_generator(0, n)) for n in names])
    noise = nn.functional.pixel_shuffle(drawn, 2)

    def error(options: SamplerConfig) -> float:
        """Of the picture's scale, which is all that the flow changes."""
        timesteps = solver_of(denoiser.schedule, options).timesteps
        start = denoiser.spread_at(denoiser.schedule.alphas_cumprod[timesteps[0]])
        made = sample_views(denoiser, batch, options, [view_generator(0, n) for n in names])
        return float(((made / noise) * start / denoiser.spread - 1).abs().mean())

    first_order = error(SamplerConfig("ddim", steps=50))
    assert error(SamplerConfig(solver, steps=15)) < first_order
    assert error(SamplerConfig(solver, steps=60)) < 0.25 * first_order


def test_timesteps_even_in_log_snr_are_distinct_and_reach_both_ends(config: ModelConfig) -> None:
    alphas = noise_schedule(config).alphas_cumprod.clamp(min=2**-24)
    for count in (1, 2, 15, 60, 1000):
        levels = even_in_log_snr(alphas, count)
        assert levels[0] == 999
        assert (levels.diff() < 0).all()
        assert count == 1 or levels[-1] == 0
    ratio = 0.5 * torch.log(alphas / (1 - alphas))
    steps = ratio[even_in_log_snr(alphas, 12)][1:].diff()
    assert steps.max() / steps.min() < 1.3


def test_steps_without_guidance_pass_the_network_once(
    config: ModelConfig, batch: PairBatch
) -> None:
    model = _randomised(config)
    sizes: list[int] = []
    model.unet.register_forward_pre_hook(lambda _, args: sizes.append(len(args[0])))
    options = SamplerConfig(steps=4, guidance=3.0, guidance_interval=[0.4, 0.8])
    sample_views(model, batch, options, [view_generator(0, name) for name in "abc"])
    assert sizes == [3, 6, 6, 3]  # trailing steps 999, 749, 499, 249
