"""A small network that predicts the depth of a view and how sure it is.

A pixel at an edge shows one of two surfaces, never their mean: each pixel has a mixture of two
Laplace distributions over log depth, and the more likely mode is the answer (Tosi et al., SMD-Nets:
Stereo Mixture Density Networks, 2021).
"""

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from extrap_train.reconstruction.depth_prediction.observation import CHANNELS, ENTRY, MEASURED
from extrap_train.weight_files import WeightFile, write_tensors

PATCH = 4
"""Side of the patches that the network sees as one pixel."""
WIDTHS = (48, 64, 96, 128)
"""Channels at a quarter, an eighth, … of the picture's side."""
CONFIDENT_WITHIN = 0.02
"""Relative error of depth that the confidence is about."""
_SCALES = (0.002, 1.0)
"""Range of the spread of a mode, in log depth."""
_OUTPUTS = 5


@dataclass(frozen=True)
class DepthMixture:
    """Two modes per pixel."""

    modes: Float[Tensor, "b 2 h w"]
    """Log depth."""
    spreads: Float[Tensor, "b 2 h w"]
    log_shares: Float[Tensor, "b 2 h w"]

    def negative_log_likelihood(self, log_depth: Float[Tensor, "b h w"]) -> Float[Tensor, "b h w"]:
        """Negative log-likelihood of the true log depth, per pixel."""
        off = (log_depth[:, None] - self.modes).abs() / self.spreads
        return -torch.logsumexp(self.log_shares - (2 * self.spreads).log() - off, 1)

    def best(self) -> tuple[Float[Tensor, "b h w"], Float[Tensor, "b h w"]]:
        """The mode of the higher density, and the probability that it is right to within
        `CONFIDENT_WITHIN`.
        """
        density = self.log_shares - self.spreads.log()
        is_second = (density[:, 1:] > density[:, :1]).long()
        mode = self.modes.gather(1, is_second)
        low, high = (
            _laplace_cdf((mode + step - self.modes) / self.spreads)
            for step in (-CONFIDENT_WITHIN, CONFIDENT_WITHIN)
        )
        return mode[:, 0], ((high - low) * self.log_shares.exp()).sum(1)


class DepthNetwork(nn.Module):
    """A UNet on patches of 4 × 4 pixels; sides must be multiples of 32."""

    spread_factor: Tensor
    """What the spreads are multiplied by, so that the confidence is true (`calibrate`)."""

    def __init__(self, widths: tuple[int, ...] = WIDTHS) -> None:
        super().__init__()
        self.stem = nn.Conv2d(PATCH**2 * CHANNELS, widths[0], 1)
        self.down = nn.ModuleList(
            nn.Conv2d(one, other, 3, stride=2, padding=1) for one, other in pairwise(widths)
        )
        self.encode = nn.ModuleList(_Residual(width) for width in widths)
        self.up = nn.ModuleList(
            nn.Conv2d(one + other, one, 3, padding=1) for one, other in pairwise(widths)
        )
        self.decode = nn.ModuleList(_Residual(width) for width in widths[:-1])
        self.head = nn.Conv2d(widths[0], PATCH**2 * _OUTPUTS, 3, padding=1)
        self.register_buffer("spread_factor", torch.ones(()))
        for parameter in self.head.parameters():
            nn.init.zeros_(parameter)

    def forward(self, features: Float[Tensor, "b c h w"]) -> DepthMixture:
        """One mode starts at what was measured, the other where the ray enters unobserved space."""
        x = self.stem(functional.pixel_unshuffle(features, PATCH))
        kept = []
        for level, encode in enumerate(self.encode):
            x = encode(x if level == 0 else self.down[level - 1](x))
            kept.append(x)
        for level in reversed(range(len(self.up))):
            x = functional.interpolate(x, scale_factor=2.0, mode="nearest")
            x = self.decode[level](self.up[level](torch.cat([kept[level], x], 1)))
        out = functional.pixel_shuffle(self.head(functional.silu(x)), PATCH)
        start = features[:, [MEASURED, ENTRY]]
        low, high = (torch.tensor(scale).log().item() for scale in _SCALES)
        return DepthMixture(
            modes=start + out[:, 0:2],
            spreads=(low + (high - low) * torch.sigmoid(out[:, 2:4])).exp() * self.spread_factor,
            log_shares=functional.log_softmax(
                torch.stack([out[:, 4], torch.zeros_like(out[:, 4])], 1), 1
            ),
        )


class _Residual(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.GroupNorm(8, width),
            nn.SiLU(),
            nn.Conv2d(width, width, 3, padding=1),
            nn.GroupNorm(8, width),
            nn.SiLU(),
            nn.Conv2d(width, width, 3, padding=1),
        )

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        out: Tensor = x + self.layers(x)
        return out


def _laplace_cdf(x: Tensor) -> Tensor:
    tail = 0.5 * torch.exp(-x.abs())
    return torch.where(x < 0, tail, 1 - tail)


def save_depth_network(network: DepthNetwork, path: Path) -> None:
    """Write the weights in half precision."""
    state = {name: value.half().contiguous() for name, value in network.state_dict().items()}
    write_tensors(state, path)


def load_depth_network(path: Path) -> DepthNetwork:
    """The network that `save_depth_network` wrote, ready for use; InputError for another file."""
    network = DepthNetwork()
    file = WeightFile(path, "complete.depth_network", "weights of task=depth")
    file.fill(network, file.tensors(file.read()))
    return network.eval()
