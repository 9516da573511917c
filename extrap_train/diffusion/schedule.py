"""The noise schedule: Stable Diffusion's, with zero terminal SNR where the model asks for it; and
the solvers that run it backwards.
"""

import copy
from typing import Any

from diffusers import DDIMScheduler, DPMSolverMultistepScheduler, UniPCMultistepScheduler

from extrap_train.config import ModelConfig, SamplerConfig

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


def solver_of(schedule: DDIMScheduler, config: SamplerConfig) -> Any:
    """The diffusers scheduler that walks down a model's noise levels, with its steps laid out.

    `ddim` keeps the spacing that the model's family was published with. The second-order ones,
    DPM-Solver++(2M) (Lu et al. 2022) and UniPC (Zhao et al. 2023), start at the noisiest step: with
    few steps, beginning below it would leave the noise of a step nobody trained for.
    """
    if config.solver == "ddim":
        solver: Any = copy.deepcopy(schedule)
    else:
        noiseless = "zero" if schedule.config["set_alpha_to_one"] else "sigma_min"
        solver = _MULTISTEP[config.solver].from_config(
            {key: schedule.config[key] for key in _SCHEDULE_KEYS},
            timestep_spacing="trailing",
            final_sigmas_type=noiseless,
        )
    solver.set_timesteps(config.steps)
    return solver


_SCHEDULE_KEYS = (
    "num_train_timesteps",
    "beta_start",
    "beta_end",
    "beta_schedule",
    "prediction_type",
    "rescale_betas_zero_snr",
)
