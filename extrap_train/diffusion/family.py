"""The three families of denoisers: which channels each is told, which pose, and what its null
condition takes away.

| family | behind the noisy latent | pose | null condition |
|---|---|---|---|
| `zeronvs` | reference latent | ZeroNVS | no image embedding, no reference latent |
| `megascenes` | reference latent, RGB of the nearest reference's warp | MegaScenes | the same |
| `ours` | `conditioning.concatenated_latents` | ZeroNVS | everything |

The published families keep pose and warp in the null condition, because their training never
dropped these.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.config import ModelConfig
from extrap_train.diffusion.conditioning import (
    Null,
    concatenated_latents,
    condition_channels,
    filled_warp,
    geometry_channels,
    reference_latent,
    warp_of,
)
from extrap_train.diffusion.encoders import Autoencoder
from extrap_train.diffusion.pose_encoding import depth_scale, megascenes_pose, zeronvs_pose
from extrap_train.geometry.resample import lanczos_resize
from extrap_train.views import PairBatch, Warp


class Family:
    """A family of models. This class is `zeronvs` (Sargent et al. 2024), which is conditioned on
    the reference and the pose, not on the warp; the others override what differs.

    Batches must hold their warp.
    """

    def channels(self, latent_channels: int, config: ModelConfig) -> int:
        """How many channels stand behind the noisy latent."""
        return latent_channels

    def latents(
        self, batch: PairBatch, autoencoder: Autoencoder, config: ModelConfig
    ) -> tuple[Float[Tensor, "b c h w"], Float[Tensor, "b z h w"]]:
        """These channels, and the latent that the denoised one is relative to."""
        reference = reference_latent(batch, autoencoder)
        return reference, torch.zeros_like(reference)

    def pose(self, batch: PairBatch) -> Float[Tensor, "b 19"]:
        """The query's pose relative to the nearest reference."""
        return zeronvs_pose(batch.reference_cameras[:, 0], batch.camera, _zeronvs_scale(batch))

    def null(self, latent_channels: int, embedding_width: int) -> Null:
        """What the null condition takes away of latents and embedding."""
        return Null(latent_channels, embedding_width)


class MegaScenes(Family):
    """Also the nearest reference's warp (Tung et al. 2024), black in its holes.

    With `residual` the denoised latent is relative to that warp, its holes filled; the published
    model has `residual: false`.
    """

    def channels(self, latent_channels: int, config: ModelConfig) -> int:
        """The warp is not encoded but shrunk to the latents' size: three colours."""
        return latent_channels + 3

    def latents(
        self, batch: PairBatch, autoencoder: Autoencoder, config: ModelConfig
    ) -> tuple[Float[Tensor, "b c h w"], Float[Tensor, "b z h w"]]:
        """See `Family.latents`."""
        reference, base = super().latents(batch, autoencoder, config)
        warp = _nearest_warp(batch)
        # What is not a network keeps its precision where the caller lets the network run in less.
        with torch.autocast(reference.device.type, enabled=False):
            shrunk = lanczos_resize(warp.image, *reference.shape[-2:]).clamp(0, 1) * 2 - 1
        if config.residual:
            base = autoencoder.encode(filled_warp(warp))
        return torch.cat([reference, shrunk], 1), base

    def pose(self, batch: PairBatch) -> Float[Tensor, "b 19"]:
        """See `Family.pose`."""
        return megascenes_pose(
            batch.reference_cameras[:, 0],
            batch.camera,
            depth_scale(batch.reference_depths[:, 0], every=1, least=1e-7),
        )


class Ours(Family):
    """The fused warp of several references with its positional encoding."""

    def channels(self, latent_channels: int, config: ModelConfig) -> int:
        """See `Family.channels`."""
        return condition_channels(latent_channels, config.octaves, config.geometry)

    def latents(
        self, batch: PairBatch, autoencoder: Autoencoder, config: ModelConfig
    ) -> tuple[Float[Tensor, "b c h w"], Float[Tensor, "b z h w"]]:
        """See `Family.latents`."""
        latents, warped = concatenated_latents(batch, autoencoder, config.octaves)
        if config.geometry:
            told = geometry_channels(warp_of(batch), _zeronvs_scale(batch), autoencoder.factor)
            latents = torch.cat([latents, told], 1)
        return latents, warped if config.residual else torch.zeros_like(warped)

    def null(self, latent_channels: int, embedding_width: int) -> Null:
        """Everything."""
        return Null()


def _nearest_warp(batch: PairBatch) -> Warp:
    """The batch's warp, which must be of the nearest reference alone: made at the finer size and
    corrected as every other, which cannot be made up for once the batch is reduced.
    """
    columns = batch.reference_images.shape[1]
    if columns != 1:
        raise ValueError(f"{columns} references for a model that is told of the nearest alone")
    return warp_of(batch)


FAMILIES: dict[str, Family] = {"zeronvs": Family(), "megascenes": MegaScenes(), "ours": Ours()}


def _zeronvs_scale(batch: PairBatch) -> Float[Tensor, " b"]:
    return depth_scale(batch.reference_depths[:, 0], every=4, least=1e-2)
