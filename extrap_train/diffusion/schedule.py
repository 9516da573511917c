"""The noise schedule: Stable Diffusion's, with zero terminal SNR where the model asks for it."""

from diffusers import DDIMScheduler

from extrap_train.config import ModelConfig


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
