"""What a denoiser takes over from one of another family: all layers but the first, and of the first
(and of the token's projection) whatever means the same.

| from → to | input channels | pose |
|---|---|---|
| `zeronvs` → any | its own; the new ones start at zero: the output is as before | as it is |
| `ours` → `zeronvs` | noisy and reference latent; warp, encoding and mask are cut off | the same |
| `ours` → `megascenes` | these, and the warp's latent summed to its RGB | turned, see below |

A narrowed denoiser was never without what is cut off: it is a start, and no model, before it is
trained. Published weights have VAE latents, of which no sum is an RGB: only pixel patches narrow.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.diffusion.autoencoder import PixelPatches
from extrap_train.diffusion.pose_encoding import POSE_CHANNELS

_OPENGL = torch.tensor([1.0, -1.0, -1.0, 1.0])
"""What OpenGL's axes are in OpenCV's."""
_SQUASH = 0.5
"""Slope at 0 of ZeroNVS's squashed translation, 5·tanh(t/10)."""


def widened(weight: Float[Tensor, "o i k k"], channels: int) -> Float[Tensor, "o c k k"]:
    """First layer with zeros for the channels that it was not told."""
    zeros = weight.new_zeros(len(weight), channels - weight.shape[1], *weight.shape[2:])
    return torch.cat([weight, zeros], 1)


def narrowed(
    weight: Float[Tensor, "o i k k"], patches: PixelPatches, family: str
) -> Float[Tensor, "o c k k"]:
    """First layer of `ours` without what `family` is not told.

    The sum over a patch's pixels answers to an RGB in [−1, 1] as the layer did to a patch of that
    one colour; in holes, which `ours` sees filled and `megascenes` black, it does not.
    """
    z = patches.channels
    kept = weight[:, : 2 * z]
    if family == "zeronvs":
        return kept
    rgb = weight[:, 2 * z : 3 * z].unflatten(1, (3, -1)).sum(2) * (patches.gain / 2)
    return torch.cat([kept, rgb], 1)


def turned_pose(weight: Float[Tensor, "t d"]) -> Float[Tensor, "t d"]:
    """Projection that reads MegaScenes's pose as it read ZeroNVS's.

    Axes exactly; the translation as ZeroNVS's near zero, where it is not squashed yet. The field of
    view is left: another angle of the same lens, which no factor turns into the other.
    """
    factors = _OPENGL[:, None] * _OPENGL
    factors[:3, 3] *= _SQUASH
    start = weight.shape[1] - POSE_CHANNELS
    turned = weight.clone()
    turned[:, start : start + 16] *= factors.flatten().to(weight)
    return turned
