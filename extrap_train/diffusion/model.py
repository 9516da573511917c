"""The view-extrapolation model: everything between a batch of references and the denoiser's
prediction.
"""

from typing import Any

import torch
from diffusers import DDIMScheduler, UNet2DConditionModel
from jaxtyping import Float, Int
from torch import Tensor, nn

from extrap_train.config import ModelConfig, UNetConfig
from extrap_train.diffusion.conditioning import Conditioning
from extrap_train.diffusion.encoders import (
    ClipImageEncoder,
    KlAutoencoder,
    build_autoencoder,
    build_image_encoder,
    draw_latent,
)
from extrap_train.diffusion.family import FAMILIES
from extrap_train.diffusion.pose_encoding import POSE_CHANNELS
from extrap_train.diffusion.step_noise import StepNoise
from extrap_train.errors import InputError
from extrap_train.views import PairBatch


class ExtrapolationModel(nn.Module):
    """Denoiser, image encoder, projection to the token, and the latent space they work in.

    Small or full size, of any family: the configuration chooses the parts, and nothing else
    differs. A VAE and CLIP are frozen and no modules of it (`encoders.Frozen`).
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

        Raises InputError for views of another size: a denoiser generates nothing sensible there.
        """
        if (batch.camera.height, batch.camera.width) != (self.config.image_size,) * 2:
            raise InputError(
                f"views of {batch.camera.width} x {batch.camera.height} pixels, but the model was "
                f"trained on {self.config.image_size} x {self.config.image_size}: resize them"
            )
        latents, base = self.family.latents(batch, self.autoencoder, self.config)
        cached = batch.features
        image = (
            cached.reference_embedding
            if cached is not None
            else self.image_encoder(batch.reference_images[:, 0])
        )
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
        batch: PairBatch,
        conditioning: Conditioning,
        draws: StepNoise | None = None,
    ) -> Float[Tensor, "b z h2 w2"]:
        """What is denoised: the target's latent, relative to the condition's base.

        With `draws` the latent is drawn from the autoencoder's posterior, where it has one.
        """
        if (cached := batch.features) is not None:
            latent = draw_latent(cached.target_mean, cached.target_std, draws)
        else:
            latent = self.autoencoder.encode(batch.image, draws)
        return latent - conditioning.base

    def decode_target(
        self, latent: Float[Tensor, "b z h2 w2"], conditioning: Conditioning
    ) -> Float[Tensor, "b 3 h w"]:
        """The image in [0, 1] of a denoised latent."""
        return self.autoencoder.decode(latent + conditioning.base).clamp(0, 1)


def build_unet(
    config: UNetConfig, in_channels: int, out_channels: int, latent_size: int
) -> UNet2DConditionModel:
    """A randomly initialised UNet; its last layer starts at zero, so that training starts calm."""
    down = ["CrossAttnDownBlock2D" if level else "DownBlock2D" for level in config.attention_levels]
    up = ["CrossAttnUpBlock2D" if level else "UpBlock2D" for level in config.attention_levels[::-1]]
    unet = UNet2DConditionModel(
        sample_size=latent_size,
        in_channels=in_channels,
        out_channels=out_channels,
        block_out_channels=tuple(config.channels),
        layers_per_block=config.layers_per_block,
        down_block_types=tuple(down),
        up_block_types=tuple(up),
        cross_attention_dim=config.token_width,
        attention_head_dim=config.heads,  # diffusers' historical name for the number of heads
        norm_num_groups=config.norm_groups,
    )
    unet.conv_out.weight.data.zero_()
    unet.conv_out.bias.data.zero_()
    return unet


def noise_schedule(config: ModelConfig) -> DDIMScheduler:
    """1000 steps, `scaled_linear` as in ZeroNVS.

    With zero terminal SNR (Lin et al. 2023) the last step is pure noise, so sampling starts where
    training ended ("trailing"); an ε-prediction carries no information there and is refused.
    """
    assert config.prediction != "epsilon" or not config.zero_terminal_snr
    return DDIMScheduler(
        num_train_timesteps=1000,
        beta_start=0.00085,
        beta_end=0.012,
        beta_schedule="scaled_linear",
        clip_sample=False,
        set_alpha_to_one=config.zero_terminal_snr,
        steps_offset=0 if config.zero_terminal_snr else 1,
        timestep_spacing="trailing" if config.zero_terminal_snr else "leading",
        prediction_type=config.prediction,
        rescale_betas_zero_snr=config.zero_terminal_snr,
    )


def use_channels_last(model: ExtrapolationModel) -> ExtrapolationModel:
    """The model with every network's convolutions channels last, the frozen ones' too.

    The results are the same but for rounding. docs/performance.md has what it brings.
    """
    for network in model.parts().values():
        network.to(memory_format=torch.channels_last)
    return model
