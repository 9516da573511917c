"""What the denoiser is told about the query view (paper II-B).

Input channels of `model.family=ours`, in order: `noisy latent | reference latent | warped-image
latent | PE(reference) | PE(warped) | mask`, with `model.geometry` `| depth | confidence` behind
them, all at the latents' resolution, and one cross-attention token from the reference's embedding
and the relative pose. `family` has the other families.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from extrap_train.diffusion.encoders import Autoencoder
from extrap_train.geometry.cameras import coordinate_grid
from extrap_train.geometry.resample import fill_holes
from extrap_train.views import PairBatch, Warp, combine, send


@dataclass(frozen=True)
class Null:
    """What the null condition sets to zero: the first channels, None for all of them."""

    latents: int | None = None
    embedding: int | None = None


@dataclass(frozen=True)
class Conditioning:
    """A batch's condition; `zeroed` makes the null condition of classifier-free guidance."""

    latents: Float[Tensor, "b c h w"]
    """Everything that is concatenated behind the noisy latent."""
    embedding: Float[Tensor, "b d"]
    """Reference embedding and pose encoding, before their projection to the token."""
    base: Float[Tensor, "b z h w"]
    """Latent that the denoised latent is added to: the filled warp, or zero. No part of the
    condition.
    """
    token_weight: Float[Tensor, " b"]
    """1; 0 where the token is plain zeros instead of a projected embedding."""
    null: Null = Null()

    def zeroed(self, where: Bool[Tensor, " b"]) -> "Conditioning":
        """The null condition, the same in training and in sampling, for the chosen examples."""
        return replace(
            self,
            latents=_zeroed(self.latents, where, self.null.latents),
            embedding=_zeroed(self.embedding, where, self.null.embedding),
        )

    def doubled(self, *, plain_zeros: bool = False) -> "Conditioning":
        """Condition and null condition stacked along the batch, for guidance in one pass.

        `plain_zeros` is the null condition that ZeroNVS and MegaScenes sample with and never
        trained on: every channel is zero, and the token, too, which is not projected.
        """
        null = self.zeroed(torch.ones_like(self.token_weight, dtype=torch.bool))
        if plain_zeros:
            zeros = torch.zeros_like(self.latents), torch.zeros_like(self.token_weight)
            null = replace(self, latents=zeros[0], token_weight=zeros[1])
        return combine([self, null], torch.cat)


def _zeroed(
    channels: Float[Tensor, "b c *hw"], where: Bool[Tensor, " b"], count: int | None
) -> Float[Tensor, "b c *hw"]:
    dropped = torch.zeros(channels.shape[:2], dtype=torch.bool, device=channels.device)
    dropped[:, :count] = where[:, None]
    return channels * (~dropped).to(channels.dtype)[(...,) + (None,) * (channels.ndim - 2)]


def condition_channels(latent_channels: int, octaves: int, geometry: bool = False) -> int:
    """Channels of `Conditioning.latents`."""
    return 2 * latent_channels + 2 * 4 * octaves + 1 + (2 if geometry else 0)


def filled_warp(warp: Warp) -> Float[Tensor, "b 3 h w"]:
    """The warped image with its holes filled smoothly; mid-grey where nothing at all is known."""
    return fill_holes(warp.image - 0.5, warp.mask) + 0.5


def warp_of(batch: PairBatch) -> Warp:
    """The batch's warp; ValueError where it has none yet."""
    if batch.warp is None:
        raise ValueError("the batch has no warp yet: call `compute_warp` first")
    return batch.warp


def reference_latent(batch: PairBatch, autoencoder: Autoencoder) -> Float[Tensor, "b z h w"]:
    """The nearest reference's latent, as its channels expect it; computed unless it is cached."""
    if batch.features is not None:
        return batch.features.reference_mean
    return autoencoder.encode_reference(batch.reference_images[:, 0])


def concatenated_latents(
    batch: PairBatch, autoencoder: Autoencoder, octaves: int
) -> tuple[Float[Tensor, "b c h w"], Float[Tensor, "b z h w"]]:
    """The channels behind the noisy latent, and the filled warp's latent among them."""
    warp = warp_of(batch)
    reference = reference_latent(batch, autoencoder)
    warped = autoencoder.encode(filled_warp(warp))
    height, width = reference.shape[-2:]
    grid = send(coordinate_grid(height, width), reference)
    grid = grid.expand(len(reference), -1, -1, -1)
    channels = [
        reference,
        warped,
        positional_encoding(grid, octaves),
        _encode_warped(warp, octaves, autoencoder.factor),
        functional.avg_pool2d(warp.mask[:, None], autoencoder.factor),
    ]
    return torch.cat(channels, 1), warped


def geometry_channels(
    warp: Warp, scale: Float[Tensor, " b"], factor: int
) -> Float[Tensor, "b 2 h w"]:
    """Warped depth and confidence for a denoiser that is told them (`model.geometry`).

    Depth as `scale` / depth, in [0, 2], averaged over each latent's known pixels, 0 in holes;
    confidence is the splat's coverage in [0, 1], which fades towards the rim of a hole and where a
    surface was seen at a slant.
    """
    known = warp.mask[:, None]
    nearness = (scale[:, None, None] / warp.depth.clamp_min(1e-6)).clamp(0, 2)[:, None] * known
    share = functional.avg_pool2d(known, factor)
    mean = functional.avg_pool2d(nearness, factor) / share.clamp_min(1e-6)
    coverage = functional.avg_pool2d(warp.weight[:, None].clamp(0, 1), factor)
    return torch.cat([mean, coverage], 1)


def _encode_warped(warp: Warp, octaves: int, factor: int) -> Float[Tensor, "b c h w"]:
    """Encoding of the warped coordinates: averaged over each latent's known pixels first, zero in
    holes.
    """
    known = warp.nearest_mask[:, None]
    share = functional.avg_pool2d(known, factor)
    coordinates = functional.avg_pool2d(warp.coordinates * known, factor) / share.clamp_min(1e-6)
    return positional_encoding(coordinates, octaves) * (share > 0)


def positional_encoding(
    coordinates: Float[Tensor, "b 2 h w"], octaves: int
) -> Float[Tensor, "b {4*octaves} h w"]:
    """Encode normalised (u, v) with frequencies π, 2π, 4π, …

    Channels go by octave, and within one: sin u, sin v, cos u, cos v. At the lowest frequency
    [−1, 1] is one period.
    """
    b, _, h, w = coordinates.shape
    frequencies = math.pi * 2.0 ** torch.arange(octaves, device=coordinates.device)
    angle_rad = coordinates[:, None] * frequencies[:, None, None, None].to(coordinates.dtype)
    return torch.cat([angle_rad.sin(), angle_rad.cos()], 2).reshape(b, 4 * octaves, h, w)
