"""The reference photograph as one vector, for the cross-attention token."""

from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional
from transformers import CLIPVisionConfig, CLIPVisionModelWithProjection

from extrap_train.config import ClipConfig, ModelConfig
from extrap_train.diffusion.frozen import Frozen

_SMALL_WIDTH = 128
_CLIP_SIZE = 224
_CLIP_PATCH = 14
_CLIP_MEAN = (0.48145466, 0.4578275, 0.40821073)
_CLIP_STD = (0.26862954, 0.26130258, 0.27577711)


@runtime_checkable
class ImageEncoder(Protocol):
    """Images in [0, 1] to vectors of `width` numbers."""

    width: int

    def __call__(self, image: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b d"]:
        """The embeddings."""
        ...


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
    mean, std = (image.new_tensor(x)[:, None, None] for x in (_CLIP_MEAN, _CLIP_STD))
    return (resized - mean) / std


def build_image_encoder(config: ModelConfig) -> ImageEncoder:
    """The configured encoder; CLIP has random weights until some are loaded."""
    return SmallImageEncoder(_SMALL_WIDTH) if config.clip is None else ClipImageEncoder(config.clip)
