"""Semi-dense matches: LoFTR (Sun et al., CVPR 2021) from kornia, with MINIMA's weights."""

from copy import deepcopy
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float
from kornia.feature import LoFTR
from kornia.feature.loftr.loftr import default_cfg
from torch import Tensor

from extrap_train.config import LoftrMatcherConfig
from extrap_train.matching import Matches, is_known_at, resize, to_grey, to_image_pixels
from extrap_train.weight_files import WeightFile

STRIDE = 8
"""Pixels per cell of the coarse grid: both sides of a picture are multiples of it."""
PREFIX = "matcher."
"""Prefix of every name in files that LoFTR's trainer wrote."""


@dataclass(frozen=True)
class LoftrMatcher:
    """Finds a match for every cell of 8 × 8 pixels that has one, also without corners.

    Confidence is the network's own, from 0.2.
    """

    config: LoftrMatcherConfig
    network: LoFTR = field(repr=False, compare=False)

    @torch.no_grad()
    def match(
        self,
        first: Float[Tensor, "3 h w"],
        second: Float[Tensor, "3 h2 w2"],
        first_known: Bool[Tensor, "h w"] | None = None,
    ) -> Matches:
        """Mutually best cells, refined to fractions of a pixel; on the device of `first`."""
        one, two = self._working(first), self._working(second)
        found = self.network({"image0": one[None], "image1": two[None]})
        matches = Matches(
            to_image_pixels(found["keypoints0"], one.shape, first.shape),
            to_image_pixels(found["keypoints1"], two.shape, second.shape),
            found["confidence"],
        ).to(first)
        return matches if first_known is None else matches[is_known_at(first_known, matches.first)]

    def _working(self, image: Float[Tensor, "3 h w"]) -> Float[Tensor, "1 h2 w2"]:
        """Grey, its longer side as trained, both sides cut to the stride by resampling."""
        scale = self.config.image_size / max(image.shape[1:])
        cells = [max(1, int(side * scale) // STRIDE) for side in image.shape[1:]]
        device = next(self.network.parameters()).device
        return resize(to_grey(image.to(device))[None], cells[0] * STRIDE, cells[1] * STRIDE)


def read_loftr(path: Path, config: LoftrMatcherConfig, option: str) -> LoFTR:
    """The network with a file's weights, in evaluation mode; InputError if they are another's.

    MINIMA's weights were trained with the positional encoding as published, not as first coded.
    """
    options: dict[str, Any] = deepcopy(default_cfg)
    options["coarse"]["temp_bug_fix"] = True
    network = LoFTR(pretrained=None, config=options)
    file = WeightFile(path, option, config.weights)
    state = file.tensors(file.read(), "state_dict")
    file.fill(network, {name.removeprefix(PREFIX): x for name, x in state.items()})
    return network.eval().requires_grad_(False)
