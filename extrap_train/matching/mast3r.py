"""Dense matches between descriptors of MASt3R (Leroy et al., ECCV 2024), from its own network."""

from dataclasses import dataclass, field
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from extrap_train.config import Mast3rMatcherConfig
from extrap_train.depth.mast3r.network.crop import crop_for, network_input
from extrap_train.depth.mast3r.network.mast3r_checkpoint import read_network
from extrap_train.depth.mast3r.network.point_map_network import Encoding, PointMapNetwork
from extrap_train.errors import InputError
from extrap_train.matching import Matches, SeparableMatcher
from extrap_train.views import Camera, View

STEP = 8
"""Pixels between the starts of the search."""
ROUNDS = 10
"""Most times that a start moves on before it is given up."""
_ROWS = 512
"""Descriptors compared with all others at a time, for the sake of memory."""


@dataclass(frozen=True)
class EncodedPicture:
    """One picture's tokens, and the affine map from its pixels to the network's."""

    encoding: Encoding
    affine: Float[Tensor, "3 3"]


@dataclass(frozen=True)
class Mast3rMatcher(SeparableMatcher):
    """Finds matches across wide baselines and in weak texture, at most one per 8 × 8 pixels.

    Nothing is matched outside the middle of a picture that the network does not see whole: a square
    one lacks its upper and lower eighth. Confidence is q / (1 + q), where q is the geometric mean
    of the network's own confidences in the two descriptors.
    """

    config: Mast3rMatcherConfig
    network: PointMapNetwork = field(repr=False, compare=False)
    option: str = "matcher"

    @torch.no_grad()
    def match_described(self, first: EncodedPicture, second: EncodedPicture) -> Matches:
        """Pixels that are each other's nearest by descriptor, on the network's device."""
        here, there = self.network.describe(first.encoding, second.encoding)
        ones, twos = find_reciprocal(here.descriptors[0], there.descriptors[0])
        sure = (here.confidence.flatten()[ones] * there.confidence.flatten()[twos]).sqrt()
        widths = here.confidence.shape[-1], there.confidence.shape[-1]
        return Matches(
            _pixels(ones, widths[0], first.affine),
            _pixels(twos, widths[1], second.affine),
            sure / (1 + sure),
        )

    @torch.no_grad()
    def describe(self, image: Float[Tensor, "3 h w"]) -> EncodedPicture:
        """The picture as the network's encoder sees it, cropped to the shapes that it knows."""
        height, width = image.shape[1:]
        # Intrinsics of 1 follow resampling and crop as pixels do.
        view = View(
            image.cpu(), Camera(torch.eye(4), torch.eye(3), height, width), name="a picture"
        )
        patch, device = self.network.architecture.patch, self.network.mask_token.device
        crop = crop_for(view, self.config.image_size, patch, square=False, option=self.option)
        small = crop.apply(view)
        encoding = self.network.encode(network_input(small, device))
        return EncodedPicture(encoding, small.camera.intrinsics.to(device))


def find_reciprocal(
    first: Float[Tensor, "h w d"], second: Float[Tensor, "h2 w2 d"]
) -> tuple[Int[Tensor, " n"], Int[Tensor, " n"]]:
    """Pixels, row by row, whose descriptors are each other's nearest (MASt3R, section 3.3).

    Pixels of the first picture on a grid of `STEP` go to their nearest in the second and back.
    Those that return to where they were are matches; the others go on from where they arrived.
    """
    ones, twos = first.flatten(0, 1), second.flatten(0, 1)
    grid = torch.arange(len(ones), device=ones.device).view(first.shape[:2])
    start = grid[STEP // 2 :: STEP, STEP // 2 :: STEP].flatten()
    found = []
    for _ in range(ROUNDS):
        there = _nearest(ones[start], twos)
        back = _nearest(twos[there], ones)
        returned = back == start
        found.append(torch.stack([start[returned], there[returned]]))
        start = back[~returned].unique()
    pairs = torch.cat(found, dim=1).unique(dim=1)
    return pairs[0], pairs[1]


def _nearest(queries: Float[Tensor, "n d"], others: Float[Tensor, "m d"]) -> Int[Tensor, " n"]:
    """Index of the descriptor with the largest product with each query."""
    parts = [(part @ others.T).argmax(1) for part in queries.split(_ROWS)]
    return torch.cat(parts) if parts else queries.new_zeros(0, dtype=torch.long)


def _pixels(
    indices: Int[Tensor, " n"], width: int, affine: Float[Tensor, "3 3"]
) -> Float[Tensor, "n 2"]:
    """Centres of the network's pixels in the picture."""
    centres = torch.stack([indices % width, indices // width], 1) + 0.5
    return (centres - affine[:2, 2]) / affine.diagonal()[:2]


def read_mast3r(path: Path, option: str) -> PointMapNetwork:
    """The network of a file of MASt3R's; InputError if it is another's or DUSt3R's."""
    network = read_network(path, f"{option}.checkpoint")
    if network.architecture.descriptor_width is None:
        raise InputError(
            f"{option}.checkpoint={path}: has no descriptors, as DUSt3R's; give MASt3R's weights"
        )
    return network
