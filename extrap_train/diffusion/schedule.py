"""The noise schedule: Stable Diffusion's, with zero terminal SNR where the model asks for it; and
the solvers that run it backwards.
"""

from typing import Any

import torch
from diffusers import DDIMScheduler, DPMSolverMultistepScheduler, UniPCMultistepScheduler
from jaxtyping import Float, Int
from torch import Tensor

from extrap_train.config import ModelConfig, SamplerConfig, require_published

MultistepSolver = Any
"""One of the schedulers below; diffusers types none of their attributes."""
_MULTISTEP = {"dpmpp": DPMSolverMultistepScheduler, "unipc": UniPCMultistepScheduler}


def noise_schedule(config: ModelConfig) -> DDIMScheduler:
    """1000 steps, `scaled_linear` as in ZeroNVS (METHOD section 3).

    With zero terminal SNR (Lin et al. 2023) the last step is pure noise, so sampling starts where
    training ended ("trailing"); an ε-prediction says nothing there, hence it is refused.
    """
    if config.zero_terminal_snr and config.prediction == "epsilon":
        raise ValueError(
            "zero terminal SNR needs model.prediction=v_prediction or sample, not epsilon"
        )
    return DDIMScheduler(
        num_train_timesteps=1000,
        beta_start=0.00085,
        beta_end=0.012,
        beta_schedule="scaled_linear",
        clip_sample=False,
        set_alpha_to_one=config.zero_terminal_snr,
        steps_offset=0 if config.zero_terminal_snr else 1,
        timestep_spacing="trailing" if config.zero_terminal_snr else "leading",
        prediction_type=config.prediction,
        rescale_betas_zero_snr=config.zero_terminal_snr,
    )


def ddim_timesteps(schedule: DDIMScheduler, config: SamplerConfig) -> Int[Tensor, " n"]:
    """DDIM's timesteps, even in time, from the noisiest down, where sampling starts.

    Without zero terminal SNR 50 steps, and more that divide the schedule, start a stride below it,
    at 981 of 999, as ZeroNVS and MegaScenes were published ("leading"): fewer would start so far
    below that the pure noise which they are given is none of theirs. With `compat` the spacing is
    the published one whatever the number, without the noisiest step; InputError where the model is
    none of theirs.
    """
    count, levels = config.steps, schedule.config["num_train_timesteps"]
    leading = torch.arange(count - 1, -1, -1) * (levels // count) + 1
    if config.compat is not None:
        kind, pure = schedule.config["prediction_type"], schedule.config["rescale_betas_zero_snr"]
        require_published(config, kind, zero_terminal_snr=pure)
        return leading[1:]
    is_leading = schedule.config["timestep_spacing"] == "leading"
    if is_leading and _FEWEST_LEADING <= count < levels and levels % count == 0:
        return leading
    return torch.tensor([round(levels * (count - i) / count) - 1 for i in range(count)])


def multistep_solver(schedule: DDIMScheduler, config: SamplerConfig) -> MultistepSolver:
    """DPM-Solver++(2M) (Lu et al. 2022) or UniPC (Zhao et al. 2023) with its `timesteps` laid out.

    They step evenly in log-SNR down to no noise at all, in which their error terms are written:
    even in time, their last step is so long that it costs the whole gain.
    """
    options = {key: schedule.config[key] for key in _SCHEDULE_KEYS}
    solver: MultistepSolver = _MULTISTEP[config.solver].from_config(options)
    solver.set_timesteps(config.steps)
    levels = even_in_log_snr(solver.alphas_cumprod, config.steps)
    alpha = solver.alphas_cumprod[levels]
    solver.timesteps = levels
    solver.sigmas = torch.cat([((1 - alpha) / alpha).sqrt(), torch.zeros(1)])
    return solver


def sampling_timesteps(schedule: DDIMScheduler, config: SamplerConfig) -> Int[Tensor, " n"]:
    """The timesteps at which sampling asks the denoiser, whatever the solver."""
    if config.solver == "ddim":
        return ddim_timesteps(schedule, config)
    return multistep_solver(schedule, config).timesteps


def even_in_log_snr(alphas_cumprod: Float[Tensor, " t"], count: int) -> Int[Tensor, " n"]:
    """`count` timesteps from the noisiest down, log α/σ in equal steps, none twice.

    What lies below log α/σ = −4 is as good as pure noise and takes the first step alone.
    """
    log_ratio = 0.5 * torch.log(alphas_cumprod / (1 - alphas_cumprod))
    lowest = max(float(log_ratio[-1]), _PURE_NOISE)
    wanted = torch.linspace(lowest, float(log_ratio[0]), count)
    levels = [len(alphas_cumprod) - 1]
    for place, value in enumerate(wanted[1:], 1):
        nearest = int((log_ratio - value).abs().argmin())
        left = count - 1 - place  # every later step needs a level of its own
        levels.append(max(left, min(nearest, levels[-1] - 1)))
    return torch.tensor(levels)


_FEWEST_LEADING = 50
_PURE_NOISE = -4.0
_SCHEDULE_KEYS = (
    "num_train_timesteps",
    "beta_start",
    "beta_end",
    "beta_schedule",
    "prediction_type",
    "rescale_betas_zero_snr",
)
