"""Sampling views: any solver with classifier-free guidance, one generator per view."""

import zlib
from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import torch
from diffusers import DDIMScheduler
from jaxtyping import Float, Int
from torch import Tensor

from extrap_train.config import SamplerConfig
from extrap_train.diffusion.conditioning import Conditioning
from extrap_train.diffusion.guidance import acts, guidance_weights, guided
from extrap_train.diffusion.schedule import SpacedDdim, solver_of
from extrap_train.views import PairBatch


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
    generators: Sequence[torch.Generator],
) -> Float[Tensor, "b 3 h w"]:
    """Images of the batch's queries in [0, 1]; the batch must hold its warp.

    Noise is drawn on the CPU, one generator a view, so that the device does not change the picture.
    """
    conditioning = model.condition(batch)
    weights = guidance_weights(batch, config)
    solver = solver_of(model.schedule, config)
    levels = model.schedule.config["num_train_timesteps"] - 1
    latent = _noise(conditioning.base, generators)
    for timestep in solver.timesteps:
        steps = torch.full((len(latent),), int(timestep), device=latent.device)
        if acts(int(timestep) / levels, config) and not (weights == 1).all():
            prediction = _guided(model, latent, steps, conditioning, weights, config)
        else:
            prediction = model(latent, steps, conditioning)
        latent = _stepped(solver, prediction, timestep, latent, config.eta, generators)
    return model.decode_target(latent, conditioning)


def _stepped(
    solver: Any,
    prediction: Float[Tensor, "b z h w"],
    timestep: Int[Tensor, ""],
    latent: Float[Tensor, "b z h w"],
    eta: float,
    generators: Sequence[torch.Generator],
) -> Float[Tensor, "b z h w"]:
    if not isinstance(solver, SpacedDdim):
        return solver.step(prediction, timestep, latent).prev_sample
    noise = _noise(latent, generators) if eta > 0 else None
    return solver.step(prediction, timestep, latent, eta, noise)


def _noise(
    like: Float[Tensor, "b c h w"], generators: Sequence[torch.Generator]
) -> Float[Tensor, "b c h w"]:
    return torch.stack([torch.randn(like.shape[1:], generator=g) for g in generators]).to(like)


def _guided(
    model: ViewDenoiser,
    latent: Float[Tensor, "b z h w"],
    timestep: Int[Tensor, " b"],
    conditioning: Conditioning,
    weights: Float[Tensor, " b"],
    config: SamplerConfig,
) -> Float[Tensor, "b z h w"]:
    doubled = conditioning.doubled(plain_zeros=config.compat == "megascenes")
    both = model(torch.cat([latent, latent]), torch.cat([timestep, timestep]), doubled)
    conditional, null = both.chunk(2)
    return guided(conditional, null, weights, config.guidance_rescale)
