"""From tokens to a raw value per pixel: points and confidences before activation."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from extrap_train.depth.mast3r.network.attention import Mlp

POINT_CHANNELS = 4
"""Three coordinates and a confidence."""
LEVEL_WIDTHS = (96, 192, 384, 768)
FUSION_WIDTH = 256
LAST_WIDTH = 128

Tokens = Float[Tensor, "b n _"]


class ResidualUnit(nn.Module):
    """Two convolutions, each after a ReLU, beside the identity."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.conv1, self.conv2 = (nn.Conv2d(width, width, 3, padding=1) for _ in range(2))

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        """The same size and width."""
        return x + self.conv2(self.conv1(x.relu()).relu())


class Fusion(nn.Module):
    """A coarse map and the finer level beside it, at twice the finer one's size."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.out_conv = nn.Conv2d(width, width, 1)
        self.resConfUnit1, self.resConfUnit2 = ResidualUnit(width), ResidualUnit(width)

    def forward(
        self, coarse: Float[Tensor, "b c h w"], level: Float[Tensor, "b c h w"] | None = None
    ) -> Float[Tensor, "b c h2 w2"]:
        """The coarsest level has no `level` beside it."""
        if level is not None:
            coarse = coarse + self.resConfUnit1(level)
        return self.out_conv(_upsample(self.resConfUnit2(coarse)))


class Pyramid(nn.Module):
    """The decoder of a dense prediction transformer; `layer_rn` lists `layer1_rn` to `layer4_rn`.

    The published weights hold each of those four under both names.
    """

    def __init__(self) -> None:
        super().__init__()
        levels = [
            nn.Conv2d(width, FUSION_WIDTH, 3, padding=1, bias=False) for width in LEVEL_WIDTHS
        ]
        self.layer1_rn, self.layer2_rn, self.layer3_rn, self.layer4_rn = levels
        self.layer_rn = nn.ModuleList(levels)
        self.refinenet1, self.refinenet2, self.refinenet3, self.refinenet4 = (
            Fusion(FUSION_WIDTH) for _ in LEVEL_WIDTHS
        )

    def forward(self, levels: Sequence[Float[Tensor, "b _ _ _"]]) -> Float[Tensor, "b c h w"]:
        """Levels from finest to coarsest, each half the size of the one before."""
        fine = [layer(level) for layer, level in zip(self.layer_rn, levels, strict=True)]
        fused = self.refinenet4(fine[3])
        # An odd grid is rounded up on its way down.
        fused = fused[..., : fine[2].shape[-2], : fine[2].shape[-1]]
        fused = self.refinenet3(fused, fine[2])
        fused = self.refinenet2(fused, fine[1])
        return self.refinenet1(fused, fine[0])


class DensePrediction(nn.Module):
    """Dense prediction transformer head (Ranftl et al., ICCV 2021) on four levels of tokens."""

    def __init__(self, token_widths: Sequence[int]) -> None:
        super().__init__()
        first, second, third, fourth = LEVEL_WIDTHS
        resamplers: list[list[nn.Module]] = [
            [nn.ConvTranspose2d(first, first, 4, stride=4)],
            [nn.ConvTranspose2d(second, second, 2, stride=2)],
            [],
            [nn.Conv2d(fourth, fourth, 3, stride=2, padding=1)],
        ]
        self.act_postprocess = nn.ModuleList(
            nn.Sequential(nn.Conv2d(tokens, width, 1), *resampler)
            for tokens, width, resampler in zip(
                token_widths, (first, second, third, fourth), resamplers, strict=True
            )
        )
        self.scratch = Pyramid()
        self.head = nn.Sequential(
            nn.Conv2d(FUSION_WIDTH, LAST_WIDTH, 3, padding=1),
            nn.Upsample(scale_factor=2, mode="bilinear", align_corners=True),
            nn.Conv2d(LAST_WIDTH, LAST_WIDTH, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(LAST_WIDTH, POINT_CHANNELS, 1),
        )

    def forward(self, layers: Sequence[Tokens], grid: tuple[int, int]) -> Float[Tensor, "b 4 h w"]:
        """Tokens of a `grid` (rows, columns) of patches, after encoder, and half, three quarters
        and all of the decoder."""
        levels = [
            resample(tokens.mT.unflatten(-1, grid))
            for resample, tokens in zip(self.act_postprocess, layers, strict=True)
        ]
        return self.head(self.scratch(levels))


class DensePointHead(nn.Module):
    """DUSt3R's head: points and their confidence. MASt3R's has descriptors beside them."""

    def __init__(
        self, encoder_width: int, decoder_width: int, patch: int, descriptor_width: int | None
    ) -> None:
        super().__init__()
        self.patch = patch
        self.dpt = DensePrediction([encoder_width, *3 * [decoder_width]])
        if descriptor_width is not None:
            out = (descriptor_width + 1) * patch**2
            self.head_local_features = Mlp(encoder_width + decoder_width, out)

    def forward(self, layers: Sequence[Tokens], grid: tuple[int, int]) -> Float[Tensor, "b 4 h w"]:
        """`layers` are the encoder's tokens and those after every block of the decoder."""
        depth = len(layers) - 1
        return self.dpt([layers[i] for i in (0, depth // 2, depth * 3 // 4, depth)], grid)

    def features(self, layers: Sequence[Tokens], grid: tuple[int, int]) -> Float[Tensor, "b _ h w"]:
        """Descriptors and their confidence, from the last tokens of both (MASt3R, section 3.2)."""
        tokens = torch.cat([layers[0], layers[-1]], -1)
        return _unpatch(self.head_local_features(tokens), grid, self.patch)


class LinearPointHead(nn.Module):
    """DUSt3R's small head: each token gives the points of its patch."""

    def __init__(self, decoder_width: int, patch: int) -> None:
        super().__init__()
        self.patch = patch
        self.proj = nn.Linear(decoder_width, POINT_CHANNELS * patch**2)

    def forward(self, layers: Sequence[Tokens], grid: tuple[int, int]) -> Float[Tensor, "b 4 h w"]:
        """From the decoder's last tokens alone."""
        return _unpatch(self.proj(layers[-1]), grid, self.patch)


def _unpatch(tokens: Tokens, grid: tuple[int, int], patch: int) -> Float[Tensor, "b c h w"]:
    return functional.pixel_shuffle(tokens.mT.unflatten(-1, grid), patch)


def _upsample(x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h2 w2"]:
    return functional.interpolate(x, scale_factor=2, mode="bilinear", align_corners=True)
