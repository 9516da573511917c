"""Classifier-free guidance: how much, when, and how it is kept from overshooting.

Condition and null condition go through the network in one pass; where no view of a batch is guided,
the null condition is left out and the step costs half.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.config import SamplerConfig
from extrap_train.views import PairBatch


def guidance_weights(batch: PairBatch, config: SamplerConfig) -> Float[Tensor, " b"]:
    """Each view's weight of the conditional prediction against the null condition's.

    With `guidance_far` it grows in proportion to the angle between the viewing directions of query
    and nearest reference, from `guidance` at 0° to `guidance_far` at `guidance_far_deg` and beyond:
    near an input the condition says nearly everything, and guidance only hurts the colours.
    """
    near = torch.full_like(batch.camera.intrinsics[:, 0, 0], config.guidance)
    if config.guidance_far is None:
        return near
    cosine = (batch.camera.forward * batch.reference_cameras[:, 0].forward).sum(-1)
    angle_rad = torch.acos(cosine.clamp(-1, 1))
    share = (angle_rad / math.radians(config.guidance_far_deg)).clamp(0, 1)
    return near.lerp(torch.full_like(near, config.guidance_far), share)


def acts(noise_share: float, config: SamplerConfig) -> bool:
    """Whether guidance acts at this share of the noise schedule, 0 clean to 1 pure noise.

    Guidance at the noisiest steps costs variety, at the cleanest time (Kynkäänniemi et al. 2024).
    """
    lowest, highest = config.guidance_interval
    return lowest <= noise_share <= highest


def guided(
    conditional: Float[Tensor, "b z h w"],
    null: Float[Tensor, "b z h w"],
    weights: Float[Tensor, " b"],
    rescale: float,
) -> Float[Tensor, "b z h w"]:
    """null + w·(conditional − null), brought back to the conditional's spread by a share `rescale`.

    The latter is Lin et al. 2023, equations 15 and 16: guidance widens the prediction's
    distribution, which zero terminal SNR turns into burnt colours.
    """
    extrapolated = null + weights[:, None, None, None] * (conditional - null)
    if rescale == 0:
        return extrapolated
    wanted = conditional.std((1, 2, 3), keepdim=True)
    factor = wanted / extrapolated.std((1, 2, 3), keepdim=True).clamp_min(1e-8)
    return extrapolated * (1 + rescale * (factor - 1))
