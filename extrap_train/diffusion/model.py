"""The view-extrapolation model: everything between a batch of references and the denoiser's
prediction.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from extrap_train.config import ModelConfig
from extrap_train.diffusion.autoencoder import PixelPatches
from extrap_train.diffusion.conditioning import (
    Conditioning,
    concatenated_latents,
    condition_channels,
)
from extrap_train.diffusion.denoiser import build_unet
from extrap_train.diffusion.image_encoder import SmallImageEncoder
from extrap_train.diffusion.pose_encoding import POSE_CHANNELS, depth_scale, zeronvs_pose
from extrap_train.diffusion.schedule import noise_schedule
from extrap_train.views import PairBatch

_EMBEDDING_WIDTH = 128


class ExtrapolationModel(nn.Module):
    """Denoiser, image encoder, projection to the token, and the latent space they work in."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.config = config
        self.autoencoder = PixelPatches(config.patch)
        latent_channels = self.autoencoder.channels
        self.unet = build_unet(
            config.unet,
            latent_channels + condition_channels(latent_channels, config.octaves),
            latent_channels,
            config.image_size // self.autoencoder.factor,
        )
        self.image_encoder = SmallImageEncoder(_EMBEDDING_WIDTH)
        self.cc_projection = nn.Linear(_EMBEDDING_WIDTH + POSE_CHANNELS, config.unet.token_width)
        self.schedule = noise_schedule(config)

    def condition(self, batch: PairBatch) -> Conditioning:
        """The batch's condition; the batch must hold its warp."""
        latents, warped = concatenated_latents(batch, self.autoencoder, self.config.octaves)
        pose = zeronvs_pose(
            batch.reference_cameras[:, 0], batch.camera, depth_scale(batch.reference_depths[:, 0])
        )
        embedding = torch.cat([self.image_encoder(batch.reference_images[:, 0]), pose], -1)
        base = warped if self.config.residual else torch.zeros_like(warped)
        return Conditioning(latents, embedding, base)

    def forward(
        self,
        noisy: Float[Tensor, "b z h w"],
        timestep: Int[Tensor, " b"],
        conditioning: Conditioning,
    ) -> Float[Tensor, "b z h w"]:
        """The prediction (ε, v or sample, as configured) for noisy latents relative to the base."""
        token = self.cc_projection(conditioning.embedding)[:, None]
        channels = torch.cat([noisy, conditioning.latents], 1)
        return self.unet(channels, timestep, token).sample.float()

    def encode_target(
        self, image: Float[Tensor, "b 3 h w"], conditioning: Conditioning
    ) -> Float[Tensor, "b z h2 w2"]:
        """What is denoised: the image's latent, relative to the condition's base."""
        return self.autoencoder.encode(image) - conditioning.base

    def decode_target(
        self, latent: Float[Tensor, "b z h2 w2"], conditioning: Conditioning
    ) -> Float[Tensor, "b 3 h w"]:
        """The image in [0, 1] of a denoised latent."""
        return self.autoencoder.decode(latent + conditioning.base).clamp(0, 1)
