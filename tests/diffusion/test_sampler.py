"""Sampling inverts the noise that training adds, one generator per view, guidance in one pass."""

import copy
from dataclasses import replace
from typing import Any

import pytest
import torch
from diffusers import DDIMScheduler
from torch import Tensor, nn

from extrap_train.config import ModelConfig, SamplerConfig, SamplerOptions, sampler_for
from extrap_train.diffusion.conditioning import Conditioning, filled_warp
from extrap_train.diffusion.model import ExtrapolationModel, noise_schedule
from extrap_train.diffusion.sampler import (
    ddim_timesteps,
    even_in_log_snr,
    guide,
    sample_ddim,
    sample_views,
    sampling_timesteps,
    view_generator,
)
from extrap_train.errors import InputError
from extrap_train.views import PairBatch


class Oracle(nn.Module):
    """Knows the image: predicts what the true latent demands at every step."""

    def __init__(self, model: ExtrapolationModel, batch: PairBatch) -> None:
        super().__init__()
        self.model, self.schedule = model, model.schedule
        self.target = model.encode_target(batch, model.condition(batch))
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
    image = sample_views(oracle, batch, SamplerConfig(solver, steps=20), "abc")
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
    together = sample_views(model, batch, options, "abc", seed=1)
    alone = sample_views(model, batch, options, "xbz", seed=1)
    torch.testing.assert_close(together[1], alone[1], atol=1e-5, rtol=0)
    assert (together[0] - alone[0]).abs().max() > 1e-3, "another name is another noise"
    again = sample_views(model, batch, options, "abc", seed=2)
    assert (together - again).abs().amax((1, 2, 3)).min() > 1e-3, "another seed is, too"


def test_guidance_of_one_is_the_conditional_prediction(
    config: ModelConfig, batch: PairBatch
) -> None:
    model = _randomised(config)
    plain = sample_views(model, batch, SamplerConfig(steps=2, guidance=1.0), "abc")
    near = sample_views(model, batch, SamplerConfig(steps=2, guidance=1.0 + 1e-6), "abc")
    torch.testing.assert_close(plain, near, atol=1e-4, rtol=0)


def test_an_untrained_model_returns_the_filled_warp(config: ModelConfig, batch: PairBatch) -> None:
    """Its last layer is zero and it denoises a residual: at v = 0 the mean result is its base."""
    model = ExtrapolationModel(replace(config, prediction="sample")).eval()
    image = sample_views(model, batch, SamplerConfig(steps=5), "abc")
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

    def scale_error(self, batch: PairBatch, options: SamplerConfig) -> float:
        """Error of the picture's scale, which is all that the flow changes."""
        names = "abc"
        drawn = [torch.randn(12, 16, 16, generator=view_generator(0, name)) for name in names]
        timesteps = sampling_timesteps(self.schedule, options)
        start = self.spread_at(self.schedule.alphas_cumprod[timesteps[0]])
        made = sample_views(self, batch, options, names)
        ratio = made / nn.functional.pixel_shuffle(torch.stack(drawn), 2)
        return float((ratio * start / self.spread - 1).abs().mean())


@pytest.mark.parametrize("zero_snr", [False, True])
def test_every_number_of_ddim_steps_falls_from_pure_noise(
    config: ModelConfig, zero_snr: bool
) -> None:
    schedule = noise_schedule(
        replace(config, prediction="v_prediction", zero_terminal_snr=zero_snr)
    )
    for count in range(1, 1001):
        levels = ddim_timesteps(schedule, SamplerConfig(steps=count))
        assert len(levels) == count
        assert 980 < levels[0] <= 999
        assert (levels.diff() < 0).all()
        assert levels[-1] >= 0


@pytest.mark.parametrize("count", [50, 100, 200, 500])
def test_the_published_numbers_keep_their_spacing(config: ModelConfig, count: int) -> None:
    schedule = noise_schedule(replace(config, prediction="epsilon", zero_terminal_snr=False))
    plain = copy.deepcopy(schedule)
    plain.set_timesteps(count)
    ours = ddim_timesteps(schedule, SamplerConfig(steps=count))
    assert ours.tolist() == plain.timesteps.tolist()


_SCHEDULES = [
    ("epsilon", False),
    ("sample", False),
    ("v_prediction", False),
    ("sample", True),
    ("v_prediction", True),
]
"""Every prediction, with and without zero terminal SNR; of pure noise alone, ε says nothing."""


def _ddim(schedule: DDIMScheduler, steps: int, eta: float) -> list[Tensor]:
    """The latents of a walk whose denoiser says something else at each step: those that it is
    asked for, then the last.
    """
    asked: list[Tensor] = []
    generator = view_generator(0, "walk")

    def denoise(latent: Tensor, timestep: int) -> Tensor:
        asked.append(latent)
        return _said(timestep)

    def draw_noise() -> Tensor:
        return torch.randn(1, 4, 3, 3, generator=generator)

    timesteps = ddim_timesteps(schedule, SamplerConfig(steps=steps))
    last = sample_ddim(denoise, schedule, timesteps, eta, draw_noise)
    return [*asked, last]


def _said(timestep: int) -> Tensor:
    return torch.randn(1, 4, 3, 3, generator=view_generator(0, str(timestep)))


@pytest.mark.parametrize("eta", [0.0, 0.5, 0.999])
@pytest.mark.parametrize(
    ("prediction", "zero_snr", "count"),
    [("epsilon", False, 50), ("sample", True, 2), ("sample", True, 50), ("v_prediction", True, 8)],
)
def test_ddim_is_diffusers_where_its_strides_have_no_rest(
    config: ModelConfig, prediction: str, zero_snr: bool, count: int, eta: float
) -> None:
    """Within the rounding of single precision, in which diffusers computes its coefficients: at
    little noise a root of them has lost half of the digits. At η = 1 its own are NaN on some
    processors.
    """
    schedule = noise_schedule(replace(config, prediction=prediction, zero_terminal_snr=zero_snr))
    plain = copy.deepcopy(schedule)
    plain.set_timesteps(count)
    generator = view_generator(0, "walk")
    latents = [torch.randn(1, 4, 3, 3, generator=generator)]
    for timestep in plain.timesteps:
        noise = torch.randn(1, 4, 3, 3, generator=generator) if eta else None
        step = plain.step(
            _said(int(timestep)), timestep, latents[-1], eta=eta, variance_noise=noise
        )
        latents.append(step.prev_sample)
    for ours, theirs in zip(_ddim(schedule, count, eta), latents, strict=True):
        torch.testing.assert_close(ours, theirs, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize(("prediction", "zero_snr"), _SCHEDULES)
@pytest.mark.parametrize("steps", [1, 2, 3, 7, 25, 50, 334, 1000])
def test_ddim_is_finite_at_every_share_of_noise(
    config: ModelConfig, prediction: str, zero_snr: bool, steps: int
) -> None:
    """At η = 1 too, where the direction vanishes at pure noise and rounding decides its sign; the
    latents are those that η comes to from below.
    """
    schedule = noise_schedule(replace(config, prediction=prediction, zero_terminal_snr=zero_snr))
    walks = [torch.stack(_ddim(schedule, steps, eta)) for eta in (0.0, 0.5, 1 - 1e-8, 1.0)]
    assert all(walk.isfinite().all() for walk in walks)
    # The direction that is left at 1 − 1e-8 is √(1 − η²) ≈ 1.4e-4 of the noise.
    torch.testing.assert_close(walks[3], walks[2], atol=2e-3, rtol=2e-3)


@pytest.mark.parametrize(("factor", "cause"), [(torch.nan, "NaN"), (torch.inf, "infinite")])
def test_pictures_that_are_not_finite_are_refused_by_name(
    config: ModelConfig, batch: PairBatch, factor: float, cause: str
) -> None:
    """Infinite ones, too, which decoding would clamp to white."""
    model = _randomised(config)

    def broken(module: nn.Module, arguments: object, said: Any) -> None:
        said.sample[1] *= factor

    model.unet.register_forward_hook(broken)
    with pytest.raises(InputError, match=f"view b: .*not finite .*{cause}"):
        sample_views(model, batch, SamplerConfig(steps=2), "abc")


@pytest.mark.parametrize("zero_snr", [False, True])
def test_more_ddim_steps_come_nearer_to_the_flow(
    config: ModelConfig, batch: PairBatch, zero_snr: bool
) -> None:
    """Those among them whose strides have a rest, from 333 steps on the greatest part of them."""
    chosen = replace(config, prediction="v_prediction", zero_terminal_snr=zero_snr)
    denoiser = GaussianDenoiser(ExtrapolationModel(chosen))
    counts = (7, 15, 60, 150, 334, 600, 1000)
    errors = [denoiser.scale_error(batch, SamplerConfig(steps=count)) for count in counts]
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 0.01


@pytest.mark.parametrize(
    ("changed", "steps", "said"),
    [
        ({}, 1, r"steps=1: the published spacing needs one of 2, 4"),
        ({}, 15, r"steps=15: the published spacing needs one of .*25, 40, 50"),
        ({"prediction": "v_prediction"}, 50, "predicts `v_prediction`: leave it out"),
        ({"prediction": "sample", "zero_terminal_snr": True}, 50, "predicts `sample`"),
    ],
)
def test_sampling_as_published_is_refused_where_nothing_was_published(
    config: ModelConfig, changed: dict[str, Any], steps: int, said: str
) -> None:
    of = {"prediction": "epsilon", "zero_terminal_snr": False} | changed
    chosen = replace(config, **of)
    options = SamplerConfig(steps=steps, compat="megascenes")
    with pytest.raises(InputError, match=said):
        ddim_timesteps(noise_schedule(chosen), options)
    with pytest.raises(InputError, match=said):
        sampler_for(SamplerOptions(steps=steps, compat="megascenes"), chosen)


@pytest.mark.parametrize("zero_snr", [False, True])
@pytest.mark.parametrize("solver", ["dpmpp", "unipc"])
def test_second_order_solvers_follow_the_flow_in_fewer_steps(
    config: ModelConfig, batch: PairBatch, solver: str, zero_snr: bool
) -> None:
    """Against the exact solution of the flow: noise scaled by the spreads' ratio."""
    chosen = replace(config, prediction="v_prediction", zero_terminal_snr=zero_snr)
    denoiser = GaussianDenoiser(ExtrapolationModel(chosen))
    first_order = denoiser.scale_error(batch, SamplerConfig("ddim", steps=50))
    assert denoiser.scale_error(batch, SamplerConfig(solver, steps=15)) < first_order
    assert denoiser.scale_error(batch, SamplerConfig(solver, steps=60)) < 0.25 * first_order


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


def test_steps_without_guidance_pass_the_network_with_half_as_many_views(
    config: ModelConfig, batch: PairBatch
) -> None:
    model = _randomised(config)
    sizes: list[int] = []
    model.unet.register_forward_pre_hook(lambda _, args: sizes.append(len(args[0])))
    sample_views(model, batch, SamplerConfig(steps=2, guidance=1.0), "abc")
    sample_views(model, batch, SamplerConfig(steps=2, guidance=3.0), "abc")
    assert sizes == [3, 3, 6, 6]


def test_rescaled_guidance_has_the_spread_of_the_conditional() -> None:
    generator = torch.Generator().manual_seed(0)
    conditional, null = torch.randn(2, 2, 3, 4, 4, generator=generator)
    plain = guide(conditional, null, 4.0, 0.0)
    torch.testing.assert_close(plain, 4 * conditional - 3 * null)
    torch.testing.assert_close(guide(conditional, null, 1.0, 0.0), conditional)
    whole = guide(conditional, null, 4.0, 1.0)
    torch.testing.assert_close(whole.std((1, 2, 3)), conditional.std((1, 2, 3)))
    torch.testing.assert_close(guide(conditional, null, 4.0, 0.5), (plain + whole) / 2)
