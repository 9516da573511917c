"""Sparse matches: ALIKED's keypoints (Zhao et al., 2023) from kornia, by mutual descriptors."""

from dataclasses import dataclass, field
from pathlib import Path

import torch
from jaxtyping import Float
from kornia.feature import ALIKED, match_smnn
from torch import Tensor

from extrap_train.config import AlikedMatcherConfig
from extrap_train.matching import Matches, SeparableMatcher, resize, to_image_pixels
from extrap_train.weight_files import WeightFile

MAX_RATIO = 0.9
"""Largest ratio of the distances to the nearest and second nearest descriptor, both ways."""
CONSTANTS = ("dkd.hw_grid",)
"""The detector's constants: part of its state, but not of the published file."""

DescribedKeypoints = tuple[Float[Tensor, "_ 2"], Float[Tensor, "_ d"]]


@dataclass(frozen=True)
class AlikedMatcher(SeparableMatcher):
    """Works across wide baselines where there is texture.

    Confidence is 1 minus the ratio of the nearest descriptor's distance to the second one's.
    """

    config: AlikedMatcherConfig
    network: ALIKED = field(repr=False, compare=False)

    def match_described(self, first: DescribedKeypoints, second: DescribedKeypoints) -> Matches:
        """Matches that are unique among the keypoints of both, on the network's device."""
        (points, descriptors), (others, other_descriptors) = first, second
        ratios, pairs = match_smnn(descriptors, other_descriptors, MAX_RATIO)
        return Matches(points[pairs[:, 0]], others[pairs[:, 1]], 1 - ratios[:, 0])

    @torch.no_grad()
    def describe(self, image: Float[Tensor, "3 h w"]) -> DescribedKeypoints:
        """Keypoints in the picture's pixels, and their descriptors."""
        scale = min(1.0, self.config.image_size / max(image.shape[1:]))
        height, width = (max(1, round(side * scale)) for side in image.shape[1:])
        device = next(self.network.parameters()).device
        working = resize(image.to(device), height, width)
        (found,) = self.network(working[None])
        return to_image_pixels(found.keypoints, working.shape, image.shape), found.descriptors


def read_aliked(path: Path, config: AlikedMatcherConfig, option: str) -> ALIKED:
    """The detector with a file's weights, in evaluation mode; InputError if they are another's."""
    # Without a threshold the strongest keypoints are taken, however weak.
    network = ALIKED(max_num_keypoints=config.keypoints, detection_threshold=0.0)
    file = WeightFile(path, option, config.weights)
    own = network.state_dict()
    file.fill(network, {name: own[name] for name in CONSTANTS} | file.tensors(file.read()))
    return network.eval().requires_grad_(False)
