"""Transformer blocks whose attention knows where in the picture a token lies."""

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional

ROTARY_BASE = 100.0
"""Base of the geometric series of wavelengths (`RoPE100`)."""
NORM_EPS = 1e-6
MLP_RATIO = 4


def token_positions(
    rows: int, columns: int, device: torch.device | str = "cpu"
) -> Int[Tensor, "n 2"]:
    """(row, column) of every token of a grid, row by row."""
    grid = torch.meshgrid(
        torch.arange(rows, device=device), torch.arange(columns, device=device), indexing="ij"
    )
    return torch.stack(grid, -1).reshape(-1, 2)


def rotate(
    features: Float[Tensor, "b heads n width"], positions: Int[Tensor, "n 2"]
) -> Float[Tensor, "b heads n width"]:
    """Rotary encoding (Su et al., 2021) in two dimensions.

    The first half of each head turns with the token's row, the second with its column. Within a
    half of 2m features, feature i and feature i + m turn by position · base^(−i/m).
    """
    width = features.shape[-1] // 2
    exponents = torch.arange(width // 2, device=features.device) * (2 / width)
    angles_rad = positions.T[:, :, None] * ROTARY_BASE**-exponents
    cos, sin = (x.to(features.dtype) for x in (angles_rad.cos(), angles_rad.sin()))
    turned = []
    for half, c, s in zip(features.chunk(2, -1), cos, sin, strict=True):
        low, high = half.chunk(2, -1)
        turned += [low * c - high * s, high * c + low * s]
    return torch.cat(turned, -1)


class Attention(nn.Module):
    """Self-attention with rotated queries and keys."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(width, 3 * width)
        self.proj = nn.Linear(width, width)

    def forward(
        self, x: Float[Tensor, "b n width"], positions: Int[Tensor, "n 2"]
    ) -> Float[Tensor, "b n width"]:
        """Every token from all tokens of its own picture."""
        q, k, v = (_split(part, self.heads) for part in self.qkv(x).chunk(3, -1))
        return self.proj(_attend(rotate(q, positions), rotate(k, positions), v))


class CrossAttention(nn.Module):
    """Attention to the other picture's tokens, with rotated queries and keys."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.projq, self.projk, self.projv, self.proj = (nn.Linear(width, width) for _ in range(4))

    def forward(
        self,
        x: Float[Tensor, "b n width"],
        other: Float[Tensor, "b m width"],
        positions: Int[Tensor, "n 2"],
        other_positions: Int[Tensor, "m 2"],
    ) -> Float[Tensor, "b n width"]:
        """Every token of `x` from all tokens of `other`."""
        q = rotate(_split(self.projq(x), self.heads), positions)
        k = rotate(_split(self.projk(other), self.heads), other_positions)
        return self.proj(_attend(q, k, _split(self.projv(other), self.heads)))


def _split(x: Float[Tensor, "b n width"], heads: int) -> Float[Tensor, "b heads n part"]:
    return x.unflatten(-1, (heads, -1)).transpose(1, 2)


def _attend(
    q: Float[Tensor, "b heads n part"],
    k: Float[Tensor, "b heads m part"],
    v: Float[Tensor, "b heads m part"],
) -> Float[Tensor, "b n width"]:
    return functional.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2)


class Mlp(nn.Module):
    """Two layers with a GELU between them."""

    def __init__(self, width: int, out: int | None = None) -> None:
        super().__init__()
        self.fc1 = nn.Linear(width, MLP_RATIO * width)
        self.fc2 = nn.Linear(MLP_RATIO * width, out or width)

    def forward(self, x: Float[Tensor, "b n width"]) -> Float[Tensor, "b n out"]:
        """Each token by itself."""
        return self.fc2(functional.gelu(self.fc1(x)))


class EncoderBlock(nn.Module):
    """One picture's tokens among themselves."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.norm1, self.norm2 = (nn.LayerNorm(width, NORM_EPS) for _ in range(2))
        self.attn = Attention(width, heads)
        self.mlp = Mlp(width)

    def forward(
        self, x: Float[Tensor, "b n width"], positions: Int[Tensor, "n 2"]
    ) -> Float[Tensor, "b n width"]:
        """Pre-norm residual block."""
        x = x + self.attn(self.norm1(x), positions)
        return x + self.mlp(self.norm2(x))


class DecoderBlock(nn.Module):
    """One picture's tokens among themselves, then with the other picture's."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.norm1, self.norm2, self.norm3, self.norm_y = (
            nn.LayerNorm(width, NORM_EPS) for _ in range(4)
        )
        self.attn = Attention(width, heads)
        self.cross_attn = CrossAttention(width, heads)
        self.mlp = Mlp(width)

    def forward(
        self,
        x: Float[Tensor, "b n width"],
        other: Float[Tensor, "b m width"],
        positions: Int[Tensor, "n 2"],
        other_positions: Int[Tensor, "m 2"],
    ) -> Float[Tensor, "b n width"]:
        """Pre-norm residual block; `other` stays as it is."""
        x = x + self.attn(self.norm1(x), positions)
        x = x + self.cross_attn(self.norm2(x), self.norm_y(other), positions, other_positions)
        return x + self.mlp(self.norm3(x))
