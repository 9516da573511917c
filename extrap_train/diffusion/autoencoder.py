"""Images to latents and back. The small model's latents are pixels: no network, no loss."""

from typing import Protocol, runtime_checkable

import torch
from diffusers import AutoencoderKL
from diffusers.models.autoencoders.vae import DiagonalGaussianDistribution
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from extrap_train.config import ModelConfig, VaeConfig
from extrap_train.diffusion.frozen import Frozen

LATENT_SCALE = 0.18215
"""Brings Stable Diffusion's latents to about unit spread."""
LATENT_CHANNELS = 4


@runtime_checkable
class Autoencoder(Protocol):
    """What the denoiser needs to know of its latent space."""

    channels: int
    factor: int
    """Image pixels a side of one latent."""

    def encode(
        self, image: Float[Tensor, "b 3 h w"], generator: torch.Generator | None = None
    ) -> Float[Tensor, "b c h2 w2"]:
        """Latents, of about unit spread, of images in [0, 1].

        With a (CPU) generator they are drawn from the posterior, where the latent space has one;
        without, they are its mode.
        """
        ...

    def encode_reference(self, image: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b c h2 w2"]:
        """Latents as the denoiser's reference channels expect them."""
        ...

    def decode(self, latent: Float[Tensor, "b c h2 w2"]) -> Float[Tensor, "b 3 h w"]:
        """Images, not clamped, of latents."""
        ...


class PixelPatches:
    """Square patches of pixels as channels: exact both ways.

    The gain brings natural images (spread about 0.25 around mid-grey) to the unit spread that the
    noise schedule is made for.
    """

    gain = 4.0

    def __init__(self, patch: int) -> None:
        self.factor = patch
        self.channels = 3 * patch * patch

    def encode(
        self, image: Float[Tensor, "b 3 h w"], generator: torch.Generator | None = None
    ) -> Float[Tensor, "b c h2 w2"]:
        """See `Autoencoder.encode`; there is no posterior."""
        return functional.pixel_unshuffle((image - 0.5) * self.gain, self.factor)

    def encode_reference(self, image: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b c h2 w2"]:
        """See `Autoencoder.encode_reference`: the same latents."""
        return self.encode(image)

    def decode(self, latent: Float[Tensor, "b c h2 w2"]) -> Float[Tensor, "b 3 h w"]:
        """See `Autoencoder.decode`."""
        return functional.pixel_shuffle(latent, self.factor) / self.gain + 0.5


class KlAutoencoder(Frozen):
    """Stable Diffusion's variational autoencoder, frozen."""

    channels = LATENT_CHANNELS

    def __init__(self, config: VaeConfig) -> None:
        levels = len(config.channels)
        super().__init__(
            AutoencoderKL(
                down_block_types=("DownEncoderBlock2D",) * levels,
                up_block_types=("UpDecoderBlock2D",) * levels,
                block_out_channels=tuple(config.channels),
                layers_per_block=config.layers_per_block,
                latent_channels=LATENT_CHANNELS,
                scaling_factor=LATENT_SCALE,
                sample_size=256,
            )
        )
        self.factor = 2 ** (levels - 1)

    def encode(
        self, image: Float[Tensor, "b 3 h w"], generator: torch.Generator | None = None
    ) -> Float[Tensor, "b c h2 w2"]:
        """See `Autoencoder.encode`."""
        posterior = self._posterior(image)
        latent = posterior.mean.float()
        if generator is not None:
            noise = torch.randn(latent.shape, generator=generator).to(latent)
            latent = latent + posterior.std.float() * noise
        return latent * LATENT_SCALE

    def encode_reference(self, image: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b c h2 w2"]:
        """See `Autoencoder.encode_reference`: the posterior's mode, not scaled, as in zero123."""
        return self._posterior(image).mean.float()

    @torch.no_grad()
    def _posterior(self, image: Float[Tensor, "b 3 h w"]) -> DiagonalGaussianDistribution:
        return self.network.encode(self._at(image * 2 - 1)).latent_dist

    def decode(self, latent: Float[Tensor, "b c h2 w2"]) -> Float[Tensor, "b 3 h w"]:
        """See `Autoencoder.decode`."""
        image = self.network.decode(self._at(latent / LATENT_SCALE)).sample
        return image.float() / 2 + 0.5


def build_autoencoder(config: ModelConfig) -> Autoencoder:
    """The configured latent space; a VAE has random weights until some are loaded."""
    return PixelPatches(config.patch) if config.vae is None else KlAutoencoder(config.vae)
