"""Sampling views: DDIM or a few-step solver, classifier-free guidance, one generator per view."""

import zlib
from collections.abc import Callable, Sequence
from itertools import pairwise
from math import sqrt
from typing import Protocol, runtime_checkable

import torch
from diffusers import DDIMScheduler
from jaxtyping import Float, Int
from torch import Tensor

from extrap_train.config import SamplerConfig
from extrap_train.diffusion.conditioning import Conditioning
from extrap_train.diffusion.schedule import MultistepSolver, ddim_timesteps, multistep_solver
from extrap_train.errors import InputError
from extrap_train.views import PairBatch

Denoise = Callable[[Float[Tensor, "b z h w"], int], Float[Tensor, "b z h w"]]
"""From a noisy latent and its timestep to the prediction that the schedule names."""
DrawNoise = Callable[[], Float[Tensor, "b z h w"]]


@runtime_checkable
class ViewDenoiser(Protocol):
    """All that sampling asks of a model; `ExtrapolationModel` is one."""

    schedule: DDIMScheduler

    def condition(self, batch: PairBatch) -> Conditioning:
        """What the model is told about the batch's queries."""
        ...

    def __call__(
        self,
        noisy: Float[Tensor, "b z h w"],
        timestep: Int[Tensor, " b"],
        conditioning: Conditioning,
    ) -> Float[Tensor, "b z h w"]:
        """The prediction that the schedule's `prediction_type` names."""
        ...

    def decode_target(
        self, latent: Float[Tensor, "b z h2 w2"], conditioning: Conditioning
    ) -> Float[Tensor, "b 3 h w"]:
        """Images in [0, 1] of denoised latents."""
        ...


def view_generator(seed: int, name: str) -> torch.Generator:
    """The generator of one view: the same noise, whatever batch the view is sampled in.

    Both are hashed into 32 bits: torch's CPU generator takes no more of a seed.
    """
    return torch.Generator().manual_seed(zlib.crc32(f"{seed}/{name}".encode()))


@torch.no_grad()
def sample_views(
    model: ViewDenoiser,
    batch: PairBatch,
    config: SamplerConfig,
    names: Sequence[str],
    seed: int = 0,
) -> Float[Tensor, "b 3 h w"]:
    """Images of the batch's queries in [0, 1]; the batch must hold its warp.

    A view's noise follows from `seed` and its name, and is drawn on the CPU, so that the device
    does not change the picture. Raises InputError where a picture is not finite.
    """
    conditioning = model.condition(batch)
    denoise = guided_denoiser(model, conditioning, config)
    generators = [view_generator(seed, name) for name in names]
    shape = conditioning.base.shape[1:]

    def draw_noise() -> Float[Tensor, "b z h w"]:
        drawn = torch.stack([torch.randn(shape, generator=g) for g in generators])
        return drawn.to(conditioning.base)

    if config.solver == "ddim":
        timesteps = ddim_timesteps(model.schedule, config)
        latent = sample_ddim(denoise, model.schedule, timesteps, config.eta, draw_noise)
    else:
        solver = multistep_solver(model.schedule, config)
        latent = sample_multistep(denoise, solver, draw_noise)
    images = model.decode_target(latent, conditioning)
    _require_finite(latent, images, names)
    return images


def sample_ddim(
    denoise: Denoise,
    schedule: DDIMScheduler,
    timesteps: Int[Tensor, " n"],
    eta: float,
    draw_noise: DrawNoise,
) -> Float[Tensor, "b z h w"]:
    """DDIM (Song et al. 2021) from pure noise down `timesteps`; their α is our ᾱ.

    A latent at noise level ᾱ is x = √ᾱ x₀ + √(1 − ᾱ) ε (equation 4). η = 0 is deterministic, η = 1
    is DDPM's ancestral sampling. diffusers' own step assumes a stride of 1000 // n timesteps, which
    is not where the denoiser is evaluated next when n does not divide 1000.
    """
    prediction_type = schedule.config["prediction_type"]
    levels = [*schedule.alphas_cumprod[timesteps].tolist(), float(schedule.final_alpha_cumprod)]
    x = draw_noise()
    for timestep, (alpha, alpha_next) in zip(timesteps.tolist(), pairwise(levels), strict=True):
        signal, noise = sqrt(alpha), sqrt(1 - alpha)
        prediction = denoise(x, timestep)
        if prediction_type == "epsilon":
            epsilon, x0 = prediction, (x - noise * prediction) / signal  # equation 9
        elif prediction_type == "sample":
            epsilon, x0 = (x - signal * prediction) / noise, prediction
        else:  # v = √ᾱ ε − √(1 − ᾱ) x₀ (Salimans and Ho 2022)
            epsilon, x0 = signal * prediction + noise * x, signal * x - noise * prediction
        # Equation 16. Variance and direction lie in [0, 1 − ᾱ_next]. At η = 1 and ᾱ = 0 the
        # direction is exactly 0, and rounding alone decides its sign: its root must not be NaN.
        variance = eta**2 * (1 - alpha_next) / (1 - alpha) * (1 - alpha / alpha_next)
        variance = min(max(variance, 0.0), 1 - alpha_next)
        direction = max(1 - alpha_next - variance, 0.0)
        x = sqrt(alpha_next) * x0 + sqrt(direction) * epsilon  # equation 12
        if eta > 0:
            x = x + sqrt(variance) * draw_noise()
    return x


def sample_multistep(
    denoise: Denoise, solver: MultistepSolver, draw_noise: DrawNoise
) -> Float[Tensor, "b z h w"]:
    """One of diffusers' second-order solvers, from pure noise down its timesteps."""
    latent = draw_noise()
    for timestep in solver.timesteps:
        latent = solver.step(denoise(latent, int(timestep)), timestep, latent).prev_sample
    return latent


def guided_denoiser(
    model: ViewDenoiser, conditioning: Conditioning, config: SamplerConfig
) -> Denoise:
    """The model under its condition, with classifier-free guidance unless its scale is 1.

    Guided, condition and null condition go through the network in one pass.
    """

    def conditional(latent: Float[Tensor, "b z h w"], timestep: int) -> Float[Tensor, "b z h w"]:
        return model(latent, _repeated(timestep, latent), conditioning)

    if config.guidance == 1:
        return conditional
    doubled = conditioning.doubled(plain_zeros=config.compat == "megascenes")

    def guided(latent: Float[Tensor, "b z h w"], timestep: int) -> Float[Tensor, "b z h w"]:
        twice = torch.cat([latent, latent])
        with_condition, without = model(twice, _repeated(timestep, twice), doubled).chunk(2)
        return guide(with_condition, without, config.guidance, config.guidance_rescale)

    return guided


def guide(
    conditional: Float[Tensor, "b z h w"],
    null: Float[Tensor, "b z h w"],
    scale: float,
    rescale: float,
) -> Float[Tensor, "b z h w"]:
    """null + scale · (conditional − null), its spread brought back to the conditional's by a share.

    The share `rescale` is Lin et al. 2023, equations 15 and 16: guidance widens the prediction's
    distribution, which zero terminal SNR turns into burnt colours.
    """
    extrapolated = null + scale * (conditional - null)
    if rescale == 0:
        return extrapolated
    wanted = conditional.std((1, 2, 3), keepdim=True)
    factor = wanted / extrapolated.std((1, 2, 3), keepdim=True).clamp_min(1e-8)
    return extrapolated * (1 + rescale * (factor - 1))


def _repeated(timestep: int, latent: Float[Tensor, "b z h w"]) -> Int[Tensor, " b"]:
    return torch.full((len(latent),), timestep, device=latent.device)


def _require_finite(
    latent: Float[Tensor, "b z h2 w2"], images: Float[Tensor, "b 3 h w"], names: Sequence[str]
) -> None:
    """InputError that names the first view that is not finite: decoding clamps an infinite latent
    to a picture like any other.
    """
    finite = latent.isfinite().flatten(1).all(1) & images.isfinite().flatten(1).all(1)
    if not finite.all():
        raise InputError(
            f"view {names[int(finite.int().argmin())]}: what the model painted is not finite (NaN "
            "or infinite): its weights may have diverged in training: give other weights=, or a "
            "smaller model.learning_rate; or numbers overflow in trainer.precision: give 32-true"
        )
