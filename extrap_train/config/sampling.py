"""Whether a model can be sampled as it is asked to be."""

from extrap_train.config.model import ModelConfig, SamplerConfig, SamplerOptions
from extrap_train.config.options import check_options
from extrap_train.errors import InputError

_PUBLISHED_STEPS = tuple(n for n in range(2, 501) if 1000 % n == 0)
"""Strides that go into the 1000 steps of the schedule without a rest."""


def sampler_for(options: SamplerOptions, model: ModelConfig) -> SamplerConfig:
    """How a model's views are sampled: as it recommends, but for what the options say.

    Raises InputError where the two do not go together.
    """
    sampler = options.over(model.sampler)
    check_sampler(sampler)
    if sampler.compat is not None:
        require_published(sampler, model.prediction, zero_terminal_snr=model.zero_terminal_snr)
    return sampler


def require_published(sampler: SamplerConfig, prediction: str, *, zero_terminal_snr: bool) -> None:
    """InputError where sampling as ZeroNVS and MegaScenes did (`compat`) says nothing of a model,
    or of a number of steps that they could not take.
    """
    option = f"sampler.compat={sampler.compat}"
    if prediction != "epsilon" or zero_terminal_snr:
        raise InputError(
            f"{option} samples as models were published that predict the noise, without zero "
            f"terminal SNR; this one predicts `{prediction}`: leave it out"
        )
    if sampler.steps not in _PUBLISHED_STEPS:
        raise InputError(
            f"{option} with sampler.steps={sampler.steps}: the published spacing needs one of "
            f"{', '.join(map(str, _PUBLISHED_STEPS))}, of which it leaves out the noisiest"
        )


def check_sampler(sampler: SamplerConfig) -> None:
    """InputError for settings that no model can be sampled with."""
    check_options(sampler, "sampler.")
    if sampler.solver != "ddim" and (sampler.eta > 0 or sampler.compat):
        raise InputError(
            f"sampler.solver={sampler.solver} is deterministic and none of the published runs: "
            "sampler.eta and sampler.compat need sampler.solver=ddim; without them, sampler.eta=0"
        )
