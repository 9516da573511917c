"""The denoising loss: how far a prediction is from what the schedule asks for."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass

import torch
from diffusers import DDIMScheduler
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from extrap_train.diffusion.conditioning import Conditioning
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.diffusion.step_noise import StepNoise
from extrap_train.views import PairBatch, send

Unchanged = Callable[[], AbstractContextManager[None]]
"""In its context a model that is adapted is as it was before."""


@dataclass(frozen=True)
class Anchor:
    """Where a model that is adapted is to predict what it predicted before."""

    known: Float[Tensor, "b h w"]
    """1 where the truth is learnt, 0 where the model is to stay as it was."""
    unchanged: Unchanged


def diffusion_loss(
    model: ExtrapolationModel,
    batch: PairBatch,
    draws: StepNoise,
    condition_dropout: float,
    min_snr: float | None = None,
    anchor: Anchor | None = None,
) -> Float[Tensor, ""]:
    """The training step: mean squared error of the prediction, one random noise level per example.

    The condition is dropped for a share of the examples, for classifier-free guidance. Every random
    number comes from `draws`, so that a step is a function of its seed alone; on their way to a GPU
    nothing waits for them. `min_snr` weighs the levels, see `snr_weights`.
    """
    conditioning = model.condition(batch)
    target = model.encode_target(batch, conditioning, draws)
    dropped = draws.uniform(len(target)) < condition_dropout
    levels = draws.integers(model.schedule.config["num_train_timesteps"], len(target))
    timestep = send(levels, target.device)
    noise = send(draws.normal(target.shape), target)
    conditioning = conditioning.zeroed(send(dropped, target.device))
    errors = prediction_errors(model, target, noise, timestep, conditioning, anchor)
    if min_snr is not None:
        errors = errors * snr_weights(model.schedule, timestep, min_snr)
    return errors.mean()


def prediction_errors(
    model: ExtrapolationModel,
    target: Float[Tensor, "b z h w"],
    noise: Float[Tensor, "b z h w"],
    timestep: Int[Tensor, " b"],
    conditioning: Conditioning,
    anchor: Anchor | None = None,
) -> Float[Tensor, " b"]:
    """Each example's mean squared error at a noise level of one's choice.

    With an anchor, against the truth where it is known and the unchanged model's prediction
    elsewhere, mixed by area where a latent is both.
    """
    alpha = send(model.schedule.alphas_cumprod, target)[timestep, None, None, None]
    signal, spread = alpha**0.5, (1 - alpha) ** 0.5
    noisy = signal * target + spread * noise  # equation 4 of Ho et al. 2020
    prediction = model(noisy, timestep, conditioning)
    wanted = {
        "epsilon": noise,
        "sample": target,
        "v_prediction": signal * noise - spread * target,  # Salimans and Ho 2022, appendix D
    }[model.config.prediction]
    if anchor is not None:
        with torch.no_grad(), anchor.unchanged():
            before = model(noisy, timestep, conditioning).to(wanted)
        known = functional.interpolate(anchor.known[:, None], wanted.shape[-2:], mode="area")
        wanted = torch.lerp(before, wanted, known.to(wanted).expand_as(wanted))
    return functional.mse_loss(prediction, wanted, reduction="none").mean((1, 2, 3))


def snr_weights(
    schedule: DDIMScheduler, timestep: Int[Tensor, " b"], gamma: float
) -> Float[Tensor, " b"]:
    """Min-SNR-γ: the error of the clean sample weighed by min(SNR, γ) (Hang et al. 2023).

    In terms of ε that is min(SNR, γ)/SNR, of v min(SNR, γ)/(SNR + 1). With zero terminal SNR that
    would leave the noisiest step, where sampling starts, without any weight: such schedules have
    min(SNR + 1, γ) at every step, which is v's even weight (Lin et al. 2023) under the same bound,
    and what Salimans and Ho 2022 give few-step models for this reason.
    """
    alpha = send(schedule.alphas_cumprod, timestep.device)[timestep]
    snr = alpha / (1 - alpha)
    weight = snr + 1 if schedule.config["rescale_betas_zero_snr"] else snr
    per_unit = {"epsilon": snr, "sample": torch.ones_like(snr), "v_prediction": snr + 1}
    return weight.clamp(max=gamma) / per_unit[schedule.config["prediction_type"]]
