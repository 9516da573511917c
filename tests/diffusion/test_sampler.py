"""Sampling inverts the noise that training adds, one generator per view, guidance in one pass."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor, nn

from extrap_train.config import ModelConfig, SamplerConfig
from extrap_train.diffusion.conditioning import Conditioning, filled_warp
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.diffusion.sampler import sample_views, view_generator
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
    """The exact ε of latents that are normal with spread 0.5: its probability flow has a closed
    form.
    """

    spread = 0.5

    def __init__(self, model: ExtrapolationModel) -> None:
        super().__init__()
        self.model, self.schedule = model, model.schedule
        self.condition = model.condition
        self.decode_target = lambda latent, _: nn.functional.pixel_shuffle(latent, 2)

    def forward(self, noisy: Tensor, timestep: Tensor, conditioning: Conditioning) -> Tensor:
        alpha = self.schedule.alphas_cumprod[timestep][:, None, None, None]
        return (1 - alpha).sqrt() * noisy / (alpha * self.spread**2 + 1 - alpha)


@pytest.mark.parametrize(("solver", "gain"), [("dpmpp", 3), ("unipc", 5)])
def test_second_order_solvers_need_fewer_steps(
    config: ModelConfig, batch: PairBatch, solver: str, gain: float
) -> None:
    """Against the exact solution of the flow: noise scaled by the spreads' ratio."""
    chosen = replace(config, prediction="epsilon", zero_terminal_snr=False)
    denoiser = GaussianDenoiser(ExtrapolationModel(chosen))
    names = "abc"

    def error(options: SamplerConfig) -> float:
        first = denoiser.schedule.alphas_cumprod[999 if options.solver != "ddim" else 951]
        last = denoiser.schedule.alphas_cumprod[0]
        start, end = ((a * denoiser.spread**2 + 1 - a).sqrt() for a in (first, last))
        noise = torch.stack(
            [torch.randn(12, 16, 16, generator=view_generator(0, n)) for n in names]
        )
        made = sample_views(denoiser, batch, options, [view_generator(0, n) for n in names])
        return float((made - noise * end / start).abs().mean())

    assert error(SamplerConfig(solver, steps=20)) < error(SamplerConfig("ddim", steps=20)) / gain


def test_steps_without_guidance_pass_the_network_once(
    config: ModelConfig, batch: PairBatch
) -> None:
    model = _randomised(config)
    sizes: list[int] = []
    model.unet.register_forward_pre_hook(lambda _, args: sizes.append(len(args[0])))
    options = SamplerConfig(steps=4, guidance=3.0, guidance_interval=[0.4, 0.8])
    sample_views(model, batch, options, [view_generator(0, name) for name in "abc"])
    assert sizes == [3, 6, 6, 3]  # trailing steps 999, 749, 499, 249
