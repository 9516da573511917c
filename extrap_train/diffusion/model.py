"""The view-extrapolation model: everything between a batch of references and the denoiser's
prediction.
"""

from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from extrap_train.config import ModelConfig
from extrap_train.diffusion.autoencoder import KlAutoencoder, build_autoencoder
from extrap_train.diffusion.conditioning import Conditioning
from extrap_train.diffusion.denoiser import build_unet
from extrap_train.diffusion.family import FAMILIES
from extrap_train.diffusion.image_encoder import ClipImageEncoder, build_image_encoder
from extrap_train.diffusion.pose_encoding import POSE_CHANNELS
from extrap_train.diffusion.schedule import noise_schedule
from extrap_train.errors import InputError
from extrap_train.views import PairBatch


class ExtrapolationModel(nn.Module):
    """Denoiser, image encoder, projection to the token, and the latent space they work in.

    Small or full size, of any family: the configuration chooses the parts, and nothing else
    differs. A VAE and CLIP are frozen and no modules of it (`frozen.Frozen`).
    """

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.config = config
        self.family = FAMILIES[config.family]
        self.autoencoder = build_autoencoder(config)
        latent_channels = self.autoencoder.channels
        self.unet = build_unet(
            config.unet,
            latent_channels + self.family.channels(latent_channels, config),
            latent_channels,
            config.image_size // self.autoencoder.factor,
        )
        self.image_encoder = build_image_encoder(config)
        width = self.image_encoder.width
        self.cc_projection = nn.Linear(width + POSE_CHANNELS, config.unet.token_width)
        self.null = self.family.null(latent_channels, width)
        with torch.device("cpu"):  # weights may be on the meta device until they are loaded
            self.schedule = noise_schedule(config)

    def parts(self) -> dict[str, Any]:
        """Every network of the model, the frozen ones, too, by the name of its folder on disk."""
        parts: dict[str, Any] = {"unet": self.unet, "cc_projection": self.cc_projection}
        if isinstance(self.autoencoder, KlAutoencoder):
            parts["vae"] = self.autoencoder.network
        encoder = self.image_encoder
        parts["image_encoder"] = (
            encoder.network if isinstance(encoder, ClipImageEncoder) else encoder
        )
        return parts

    def condition(self, batch: PairBatch) -> Conditioning:
        """The batch's condition; the batch must hold its warp.

        Raises InputError for views of another size: a denoiser paints nothing sensible there.
        """
        if (batch.camera.height, batch.camera.width) != (self.config.image_size,) * 2:
            raise InputError(
                f"views of {batch.camera.width} x {batch.camera.height} pixels, but the model was "
                f"trained on {self.config.image_size} x {self.config.image_size}: resize them"
            )
        latents, base = self.family.latents(batch, self.autoencoder, self.config)
        image = self.image_encoder(batch.reference_images[:, 0])
        embedding = torch.cat([image, self.family.pose(batch)], -1)
        whole = torch.ones_like(embedding[:, 0])
        return Conditioning(latents, embedding, base, whole, self.null)

    def forward(
        self,
        noisy: Float[Tensor, "b z h w"],
        timestep: Int[Tensor, " b"],
        conditioning: Conditioning,
    ) -> Float[Tensor, "b z h w"]:
        """The prediction (ε, v or sample, as configured) for noisy latents relative to the base."""
        token = self.cc_projection(conditioning.embedding)
        token = token * conditioning.token_weight[:, None].to(token.dtype)
        channels = torch.cat([noisy, conditioning.latents], 1)
        return self.unet(channels, timestep, token[:, None]).sample.float()

    def encode_target(
        self,
        image: Float[Tensor, "b 3 h w"],
        conditioning: Conditioning,
        generator: torch.Generator | None = None,
    ) -> Float[Tensor, "b z h2 w2"]:
        """What is denoised: the image's latent, relative to the condition's base.

        With a generator the latent is drawn from the autoencoder's posterior, where it has one.
        """
        return self.autoencoder.encode(image, generator) - conditioning.base

    def decode_target(
        self, latent: Float[Tensor, "b z h2 w2"], conditioning: Conditioning
    ) -> Float[Tensor, "b 3 h w"]:
        """The image in [0, 1] of a denoised latent."""
        return self.autoencoder.decode(latent + conditioning.base).clamp(0, 1)
