"""Images to latents and back, and the reference photograph to one vector for the token.

The small model's latents are patches of pixels: no network, no loss.
"""

import copy
from typing import Any

import torch
from diffusers import AutoencoderKL
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional
from transformers import CLIPVisionConfig, CLIPVisionModelWithProjection

from extrap_train.config import ClipConfig, ModelConfig, VaeConfig
from extrap_train.diffusion.step_noise import StepNoise
from extrap_train.views import send

LATENT_SCALE = 0.18215
"""Brings Stable Diffusion's latents to about unit spread."""
LATENT_CHANNELS = 4
_SMALL_WIDTH = 128
_CLIP_SIZE = 224
_CLIP_PATCH = 14
_CLIP_MEAN = (0.48145466, 0.4578275, 0.40821073)
_CLIP_STD = (0.26862954, 0.26130258, 0.27577711)


class Frozen:
    """Base of what wraps a pretrained network without making it a part of the trained model.

    Not a module on purpose: optimiser, averaged copy, DDP and checkpoints of a run then know
    nothing of it, which at full size saves gigabytes, and it follows its input to any device.
    """

    def __init__(self, network: nn.Module) -> None:
        self.network: Any = network.requires_grad_(False).eval()

    def __deepcopy__(self, memo: dict[int, Any]) -> "Frozen":
        """One network for every copy of the model: nobody changes its weights."""
        return copy.copy(self)

    def _at(self, image: Tensor) -> Tensor:
        """The image in the network's precision, with the network on the image's device."""
        weight = next(self.network.parameters())
        if weight.device != image.device:
            self.network.to(image.device)
        return image.to(weight.dtype)


class PixelPatches:
    """Square patches of pixels as channels: exact both ways.

    The gain brings natural images (spread about 0.25 around mid-grey) to the unit spread that the
    noise schedule is made for.
    """

    gain = 4.0

    def __init__(self, patch: int) -> None:
        self.factor = patch
        """Image pixels a side of one latent."""
        self.channels = 3 * patch * patch

    def encode(
        self, image: Float[Tensor, "b 3 h w"], draws: StepNoise | None = None
    ) -> Float[Tensor, "b c h2 w2"]:
        """Latents, of about unit spread, of images in [0, 1].

        With `draws` they are drawn from the posterior, where the latent space has one; without,
        they are its mode.
        """
        return functional.pixel_unshuffle((image - 0.5) * self.gain, self.factor)

    def encode_reference(self, image: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b c h2 w2"]:
        """Latents as the denoiser's reference channels expect them: here the same."""
        return self.encode(image)

    def decode(self, latent: Float[Tensor, "b c h2 w2"]) -> Float[Tensor, "b 3 h w"]:
        """Images, not clamped, of latents."""
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
        self, image: Float[Tensor, "b 3 h w"], draws: StepNoise | None = None
    ) -> Float[Tensor, "b c h2 w2"]:
        """See `PixelPatches.encode`."""
        return draw_latent(*self.posterior(image), draws)

    def encode_reference(self, image: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b c h2 w2"]:
        """See `PixelPatches.encode_reference`: the posterior's mode, not scaled, as in zero123."""
        return self.posterior(image)[0]

    @torch.no_grad()
    def posterior(
        self, image: Float[Tensor, "b 3 h w"]
    ) -> tuple[Float[Tensor, "b c h2 w2"], Float[Tensor, "b c h2 w2"]]:
        """Mean and spread of the latents of images in [0, 1], not scaled."""
        found = self.network.encode(self._at(image * 2 - 1)).latent_dist
        return found.mean.float(), found.std.float()

    def decode(self, latent: Float[Tensor, "b c h2 w2"]) -> Float[Tensor, "b 3 h w"]:
        """See `PixelPatches.decode`."""
        image = self.network.decode(self._at(latent / LATENT_SCALE)).sample
        return image.float() / 2 + 0.5


def draw_latent(
    mean: Float[Tensor, "b c h w"],
    std: Float[Tensor, "b c h w"],
    draws: StepNoise | None,
) -> Float[Tensor, "b c h w"]:
    """Scaled latents drawn from a posterior with `draws`; without, its mode."""
    if draws is not None:
        mean = mean + std * send(draws.normal(mean.shape), mean)
    return mean * LATENT_SCALE


Autoencoder = PixelPatches | KlAutoencoder


def build_autoencoder(config: ModelConfig) -> Autoencoder:
    """The configured latent space; a VAE has random weights until some are loaded."""
    return PixelPatches(config.patch) if config.vae is None else KlAutoencoder(config.vae)


class SmallImageEncoder(nn.Sequential):
    """A few strided convolutions, trained with the denoiser; the full size has CLIP here."""

    def __init__(self, width: int) -> None:
        layers: list[nn.Module] = []
        channels = 3
        for level in range(4):
            out = width // 2 ** (3 - level)
            layers += [
                nn.Conv2d(channels, out, 3, stride=2, padding=1),
                nn.GroupNorm(4, out),
                nn.SiLU(),
            ]
            channels = out
        super().__init__(*layers, nn.AdaptiveAvgPool2d(1), nn.Flatten())
        self.width = width

    def forward(self, image: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b d"]:
        """Embeddings of images in [0, 1]."""
        return super().forward(image * 2 - 1)


class ClipImageEncoder(Frozen):
    """CLIP's image tower with its projection, frozen."""

    def __init__(self, config: ClipConfig) -> None:
        super().__init__(
            CLIPVisionModelWithProjection(
                CLIPVisionConfig(
                    hidden_size=config.width,
                    intermediate_size=4 * config.width,
                    num_hidden_layers=config.layers,
                    num_attention_heads=config.heads,
                    projection_dim=config.embedding_width,
                    image_size=_CLIP_SIZE,
                    patch_size=_CLIP_PATCH,
                )
            )
        )
        self.width = config.embedding_width
        # No weight and in no file, so it must be real where the weights are still on meta.
        embeddings = self.network.vision_model.embeddings
        embeddings.position_ids = torch.arange(embeddings.num_positions, device="cpu")[None]

    @torch.no_grad()
    def __call__(self, image: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b d"]:
        """Embeddings of images in [0, 1], not normalised to unit length."""
        return self.network(self._at(clip_input(image))).image_embeds.float()


def clip_input(image: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 3 224 224"]:
    """CLIP's input as zero123 makes it: corners aligned, no antialiasing, CLIP's mean and spread.

    The published networks were trained on this very resampling, which differs from CLIP's own.
    """
    size = (_CLIP_SIZE, _CLIP_SIZE)
    resized = functional.interpolate(image, size, mode="bicubic", align_corners=True)
    mean, std = (send(torch.tensor(x), image)[:, None, None] for x in (_CLIP_MEAN, _CLIP_STD))
    return (resized - mean) / std


def build_image_encoder(config: ModelConfig) -> SmallImageEncoder | ClipImageEncoder:
    """The configured encoder; CLIP has random weights until some are loaded."""
    return SmallImageEncoder(_SMALL_WIDTH) if config.clip is None else ClipImageEncoder(config.clip)
