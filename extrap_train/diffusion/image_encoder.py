"""The reference photograph as one vector, for the cross-attention token."""

from jaxtyping import Float
from torch import Tensor, nn


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
