"""What a denoiser takes over from one of another family: all layers but the first, and of the first
(and of the token's projection) whatever means the same.

| from → to | input channels | pose |
|---|---|---|
| `zeronvs` → `ours` | its own; the new ones start at zero: the output is as before | the same |
| `zeronvs` → `megascenes` | as above, as far as the pose can be turned | turned, see below |
| `ours` → `zeronvs` | noisy and reference latent; warp, encoding and mask are cut off | the same |
| `ours` → `megascenes` | these, and the warp's latent summed to its RGB | turned, see below |

A narrowed denoiser was never without what is cut off: it is a start, and no model, before it is
trained. Published weights have VAE latents, of which no sum is an RGB: only pixel patches narrow.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.diffusion.encoders import PixelPatches
from extrap_train.diffusion.pose_encoding import POSE_CHANNELS

_OPENGL = torch.tensor([1.0, -1.0, -1.0, 1.0])
"""What OpenGL's axes are in OpenCV's."""
_SQUASH = 0.5
"""Slope at 0 of ZeroNVS's squashed translation, 5·tanh(t/10)."""
_LENSES_DEG = (20.0, 100.0)
"""Fields of view along a side between which the two families' are turned into each other."""


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


def turned_pose(
    weight: Float[Tensor, "t d"], bias: Float[Tensor, " t"]
) -> tuple[Float[Tensor, "t d"], Float[Tensor, " t"]]:
    """Projection, and its bias, that read MegaScenes's pose as they read ZeroNVS's.

    Axes exactly; the translation as ZeroNVS's near zero, where it is not squashed yet (at two scene
    scales it is 1.3 % less); a square picture's field of view within 0.006 (`_side_of_diagonal`).
    """
    weight = weight.float()
    factors = _OPENGL[:, None] * _OPENGL
    factors[:3, 3] *= _SQUASH
    start = weight.shape[1] - POSE_CHANNELS
    lens = _side_of_diagonal().to(weight)
    turned = weight.clone()
    turned[:, start : start + 16] *= factors.flatten().to(weight)
    turned[:, start + 16 :] = weight[:, start + 16 :] @ lens[:, :3]
    return turned, bias + weight[:, start + 16 :] @ lens[:, 3]


def _side_of_diagonal() -> Float[Tensor, "3 4"]:
    """(fov, sin fov, cos fov) along a square's side from those along its diagonal and 1, by least
    squares: one angle is a smooth function of the other.
    """
    side = torch.deg2rad(torch.linspace(*_LENSES_DEG, 200, dtype=torch.float64))
    diagonal = 2 * torch.atan(math.sqrt(2) * torch.tan(side / 2))
    ones = torch.ones_like(diagonal)
    told = torch.stack([diagonal, diagonal.sin(), diagonal.cos(), ones], 1)
    wanted = torch.stack([side, side.sin(), side.cos()], 1)
    return torch.linalg.lstsq(told, wanted).solution.mT
