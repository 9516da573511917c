"""The network: both pictures encoded alike, decoded with an eye on each other."""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from extrap_train.depth.mast3r.network.attention import (
    NORM_EPS,
    DecoderBlock,
    EncoderBlock,
    token_positions,
)
from extrap_train.depth.mast3r.network.heads import POINT_CHANNELS, DensePointHead, LinearPointHead

Head = Literal["dense", "linear"]


@dataclass(frozen=True)
class Architecture:
    """Sizes of the network; the defaults are those of the published MASt3R (ViT-Large)."""

    encoder_width: int = 1024
    encoder_depth: int = 24
    encoder_heads: int = 16
    decoder_width: int = 768
    decoder_depth: int = 12
    decoder_heads: int = 12
    patch: int = 16
    head: Head = "dense"
    descriptor_width: int | None = 24
    """Width of MASt3R's descriptors; None for DUSt3R, which has none."""


@dataclass(frozen=True)
class Encoding:
    """Tokens of one picture, of `grid` (rows, columns) patches."""

    tokens: Float[Tensor, "b n width"]
    grid: tuple[int, int]


@dataclass(frozen=True)
class PredictedPoints:
    """What the network says of one picture of a pair, in the *first* camera's frame; its scale is
    the network's own."""

    points: Float[Tensor, "b h w 3"]
    confidence: Float[Tensor, "b h w"]
    """From 1 (none) upwards."""


@dataclass(frozen=True)
class PredictedDescriptors:
    """MASt3R's local features of one picture of a pair."""

    descriptors: Float[Tensor, "b h w d"]
    """Of unit length; the product of two is their similarity."""
    confidence: Float[Tensor, "b h w"]
    """Above 0."""


class _PatchEmbedding(nn.Module):
    def __init__(self, width: int, patch: int) -> None:
        super().__init__()
        self.proj = nn.Conv2d(3, width, patch, stride=patch)


class PointMapNetwork(nn.Module):
    """Two views in, a point per pixel of both out. Colours are (x − ½) / ½."""

    def __init__(self, architecture: Architecture) -> None:
        super().__init__()
        a = self.architecture = architecture
        self.patch_embed = _PatchEmbedding(a.encoder_width, a.patch)
        self.mask_token = nn.Parameter(torch.zeros(1, 1, a.decoder_width))
        """Token used in pre-training: it is in the weights but not used here."""
        self.enc_blocks = nn.ModuleList(
            EncoderBlock(a.encoder_width, a.encoder_heads) for _ in range(a.encoder_depth)
        )
        self.enc_norm = nn.LayerNorm(a.encoder_width, NORM_EPS)
        self.decoder_embed = nn.Linear(a.encoder_width, a.decoder_width)
        self.dec_blocks, self.dec_blocks2 = (
            nn.ModuleList(
                DecoderBlock(a.decoder_width, a.decoder_heads) for _ in range(a.decoder_depth)
            )
            for _ in range(2)
        )
        self.dec_norm = nn.LayerNorm(a.decoder_width, NORM_EPS)
        self.downstream_head1, self.downstream_head2 = (_head(a) for _ in range(2))

    def encode(self, images: Float[Tensor, "b 3 h w"]) -> Encoding:
        """Tokens of pictures whose sides are multiples of the patch; shared by all their pairs."""
        patches = self.patch_embed.proj(images)
        grid = (patches.shape[-2], patches.shape[-1])
        tokens = patches.flatten(2).mT
        positions = token_positions(*grid, device=images.device)
        for block in self.enc_blocks:
            tokens = block(tokens, positions)
        return Encoding(self.enc_norm(tokens), grid)

    def decode(self, first: Encoding, second: Encoding) -> tuple[PredictedPoints, PredictedPoints]:
        """Both pictures' points in the first camera's frame."""
        ones, twos = self._decoded(first, second)
        return (
            _activate(self.downstream_head1(ones, first.grid)),
            _activate(self.downstream_head2(twos, second.grid)),
        )

    def describe(
        self, first: Encoding, second: Encoding
    ) -> tuple[PredictedDescriptors, PredictedDescriptors]:
        """The descriptors of both pictures' pixels; the network needs a `descriptor_width`."""
        ones, twos = self._decoded(first, second)
        return (
            _describe(self.downstream_head1, ones, first.grid),
            _describe(self.downstream_head2, twos, second.grid),
        )

    def _decoded(
        self, first: Encoding, second: Encoding
    ) -> tuple[list[Float[Tensor, "b n _"]], list[Float[Tensor, "b m _"]]]:
        """Of each picture the encoder's tokens and those after every block of the decoder."""
        here = token_positions(*first.grid, device=first.tokens.device)
        there = token_positions(*second.grid, device=second.tokens.device)
        one, two = self.decoder_embed(first.tokens), self.decoder_embed(second.tokens)
        ones, twos = [first.tokens], [second.tokens]
        for block_one, block_two in zip(self.dec_blocks, self.dec_blocks2, strict=True):
            one, two = block_one(one, two, here, there), block_two(two, one, there, here)
            ones.append(one)
            twos.append(two)
        ones[-1], twos[-1] = self.dec_norm(one), self.dec_norm(two)
        return ones, twos

    def forward(
        self, first: Float[Tensor, "b 3 h w"], second: Float[Tensor, "b 3 h2 w2"]
    ) -> tuple[PredictedPoints, PredictedPoints]:
        """`encode` and `decode` of one pair."""
        return self.decode(self.encode(first), self.encode(second))


def _head(a: Architecture) -> nn.Module:
    if a.head == "linear":
        return LinearPointHead(a.decoder_width, a.patch)
    return DensePointHead(a.encoder_width, a.decoder_width, a.patch, a.descriptor_width)


def _activate(raw: Float[Tensor, "b 4 h w"]) -> PredictedPoints:
    """Points leave the origin exponentially; the confidence is an exponential, too."""
    values = raw.permute(0, 2, 3, 1)
    points, confidence = values[..., : POINT_CHANNELS - 1], 1 + values[..., -1].exp()
    distance = points.norm(dim=-1, keepdim=True)
    return PredictedPoints(points / distance.clamp_min(1e-8) * distance.expm1(), confidence)


def _describe(
    head: nn.Module, layers: list[Float[Tensor, "b n _"]], grid: tuple[int, int]
) -> PredictedDescriptors:
    """The last of the head's features is the confidence's logarithm."""
    assert isinstance(head, DensePointHead)
    values = head.features(layers, grid).permute(0, 2, 3, 1)
    return PredictedDescriptors(
        functional.normalize(values[..., :-1], dim=-1), values[..., -1].exp()
    )
