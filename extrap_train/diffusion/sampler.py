"""Sampling views: DDIM or a few-step solver, classifier-free guidance, one generator per view."""

import zlib
from collections.abc import Callable, Sequence
from itertools import pairwise
from math import sqrt
from typing import Any, Protocol, runtime_checkable

import torch
from diffusers import DDIMScheduler, DPMSolverMultistepScheduler, UniPCMultistepScheduler
from jaxtyping import Float, Int
from torch import Tensor

from extrap_train.config import SamplerConfig, require_published
from extrap_train.diffusion.conditioning import Conditioning
from extrap_train.errors import InputError
from extrap_train.views import PairBatch, send

Denoise = Callable[[Float[Tensor, "b z h w"], int], Float[Tensor, "b z h w"]]
"""From a noisy latent and its timestep to the prediction that the schedule names."""
DrawNoise = Callable[[], Float[Tensor, "b z h w"]]
MultistepSolver = Any
"""One of the schedulers below; diffusers types none of their attributes."""
_MULTISTEP = {"dpmpp": DPMSolverMultistepScheduler, "unipc": UniPCMultistepScheduler}
_FEWEST_LEADING = 50
_PURE_NOISE = -4.0
"""log α/σ below which a latent counts as pure noise."""
_SCHEDULE_KEYS = (
    "num_train_timesteps",
    "beta_start",
    "beta_end",
    "beta_schedule",
    "prediction_type",
    "rescale_betas_zero_snr",
)


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
        return send(drawn, conditioning.base)

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
    alphas = [*schedule.alphas_cumprod[timesteps].tolist(), float(schedule.final_alpha_cumprod)]
    x = draw_noise()
    for timestep, (alpha, alpha_next) in zip(timesteps.tolist(), pairwise(alphas), strict=True):
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
    """Classifier-free guidance, null + scale · (conditional − null), with guidance rescale.

    Guidance raises the prediction's standard deviation, which zero terminal SNR turns into burnt
    colours. `rescale` interpolates from there (0) to the conditional's own standard deviation (1):
    Lin et al. 2023, equations 15 and 16.
    """
    extrapolated = null + scale * (conditional - null)
    if rescale == 0:
        return extrapolated
    wanted = conditional.std((1, 2, 3), keepdim=True)
    factor = wanted / extrapolated.std((1, 2, 3), keepdim=True).clamp_min(1e-8)
    return extrapolated * (1 + rescale * (factor - 1))


def ddim_timesteps(schedule: DDIMScheduler, config: SamplerConfig) -> Int[Tensor, " n"]:
    """DDIM's timesteps, evenly spaced, noisiest first.

    By default the first one is the schedule's noisiest, 999 ("trailing" spacing). A schedule with
    "leading" spacing, as ZeroNVS and MegaScenes were published with, starts one stride lower: at
    981 with 50 steps. That holds for 50 steps or more that divide the schedule evenly. With fewer
    the stride is so long that the first timestep would no longer be close to pure noise, which is
    what sampling starts from. `compat` forces the published spacing for any number of steps and
    drops the noisiest one; InputError where the model is not theirs.
    """
    count, train_steps = config.steps, schedule.config["num_train_timesteps"]
    leading = torch.arange(count - 1, -1, -1) * (train_steps // count) + 1
    if config.compat is not None:
        zero_snr = schedule.config["rescale_betas_zero_snr"]
        require_published(config, schedule.config["prediction_type"], zero_terminal_snr=zero_snr)
        return leading[1:]
    is_leading = schedule.config["timestep_spacing"] == "leading"
    if is_leading and _FEWEST_LEADING <= count < train_steps and train_steps % count == 0:
        return leading
    return torch.tensor([round(train_steps * (count - i) / count) - 1 for i in range(count)])


def multistep_solver(schedule: DDIMScheduler, config: SamplerConfig) -> MultistepSolver:
    """DPM-Solver++(2M) (Lu et al. 2022) or UniPC (Zhao et al. 2023) with its `timesteps` laid out.

    Their timesteps are spaced evenly in log-SNR, the variable that they integrate over, and the
    last step ends at zero noise. Spaced evenly in time, the last step would be so long in log-SNR
    that second order gains nothing.
    """
    options = {key: schedule.config[key] for key in _SCHEDULE_KEYS}
    solver: MultistepSolver = _MULTISTEP[config.solver].from_config(options)
    solver.set_timesteps(config.steps)
    timesteps = even_in_log_snr(solver.alphas_cumprod, config.steps)
    alpha = solver.alphas_cumprod[timesteps]
    solver.timesteps = timesteps
    solver.sigmas = torch.cat([((1 - alpha) / alpha).sqrt(), torch.zeros(1)])
    return solver


def sampling_timesteps(schedule: DDIMScheduler, config: SamplerConfig) -> Int[Tensor, " n"]:
    """The timesteps at which sampling asks the denoiser, whatever the solver."""
    if config.solver == "ddim":
        return ddim_timesteps(schedule, config)
    return multistep_solver(schedule, config).timesteps


def even_in_log_snr(alphas_cumprod: Float[Tensor, " t"], count: int) -> Int[Tensor, " n"]:
    """`count` different timesteps, noisiest first, about equally far apart in log α/σ.

    All that lies below `_PURE_NOISE` is covered by the first step.
    """
    log_ratio = 0.5 * torch.log(alphas_cumprod / (1 - alphas_cumprod))
    lowest = max(float(log_ratio[-1]), _PURE_NOISE)
    wanted = torch.linspace(lowest, float(log_ratio[0]), count)
    timesteps = [len(alphas_cumprod) - 1]
    for place, value in enumerate(wanted[1:], 1):
        nearest = int((log_ratio - value).abs().argmin())
        left = count - 1 - place  # every later step needs a timestep of its own
        timesteps.append(max(left, min(nearest, timesteps[-1] - 1)))
    return torch.tensor(timesteps)


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
            f"view {names[int(finite.int().argmin())]}: the generated picture is not finite (NaN "
            "or infinite). If the weights diverged in training, give other weights= or a smaller "
            "model.learning_rate; if numbers overflow, give trainer.precision=32-true"
        )
