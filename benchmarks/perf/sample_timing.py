"""Sampling a view with guidance: both predictions in one bfloat16 pass with fused attention,
against plain float32, one after the other.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.perf.diffusion_case import Run, compare_models
from benchmarks.perf.timing import Timing, devices
from extrap_train.config import SamplerConfig
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.diffusion.sampler import ddim_timesteps, sample_ddim, sample_views, view_generator
from extrap_train.views import PairBatch

_GUIDANCE = 3.0
_STEPS = {"cpu": 2, "cuda": 50}
_REPEATS = {"cpu": 3, "cuda": 5}


def run() -> list[Timing]:
    """One row per device and batch size.

    On a GPU also with torch.compile, which the validations of a training with trainer.compile=true
    sample with, and no other task.
    """
    rows = []
    for device in devices():
        steps, repeats = _STEPS[device.type], _REPEATS[device.type]
        title = f"{steps} guided steps"
        rows += compare_models(device, title, 2 * steps, sampling, plain_sampling, repeats)
    return rows


def sampling(model: ExtrapolationModel, batch: PairBatch) -> Run:
    """The product's sampler in mixed precision, the default of every task that generates."""
    device, model = batch.image.device, model.eval()
    options = SamplerConfig(steps=_STEPS[device.type], guidance=_GUIDANCE)

    def sample() -> Float[Tensor, "b 3 h w"]:
        with torch.autocast(device.type, torch.bfloat16):
            return sample_views(model, batch, options, _names(batch))

    return sample


def plain_sampling(model: ExtrapolationModel, batch: PairBatch) -> Run:
    """DDIM with guidance as one writes it down: two passes a step."""
    model, steps = model.eval(), _STEPS[batch.image.device.type]

    @torch.no_grad()
    def sample() -> Float[Tensor, "b 3 h w"]:
        condition = model.condition(batch)
        null = condition.zeroed(torch.ones_like(condition.token_weight, dtype=torch.bool))

        def denoise(latent: Float[Tensor, "b z h w"], timestep: int) -> Float[Tensor, "b z h w"]:
            times = torch.full((len(latent),), timestep, device=latent.device)
            conditional, without = model(latent, times, condition), model(latent, times, null)
            return without + _GUIDANCE * (conditional - without)

        def draw_noise() -> Float[Tensor, "b z h w"]:
            generators = [view_generator(0, name) for name in _names(batch)]
            shape = condition.base.shape[1:]
            drawn = torch.stack([torch.randn(shape, generator=g) for g in generators])
            return drawn.to(condition.base)

        timesteps = ddim_timesteps(model.schedule, SamplerConfig(steps=steps))
        latent = sample_ddim(denoise, model.schedule, timesteps, 0.0, draw_noise)
        return model.decode_target(latent, condition)

    return sample


def _names(batch: PairBatch) -> list[str]:
    return [str(i) for i in range(len(batch.image))]
