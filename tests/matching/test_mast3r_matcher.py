from dataclasses import replace

import pytest
import torch
from moved_pictures import turned
from torch.nn import functional

from extrap_train.config import Mast3rMatcherConfig
from extrap_train.depth.mast3r.network.point_map_network import (
    Architecture,
    Encoding,
    PointMapNetwork,
    PredictedDescriptors,
)
from extrap_train.errors import InputError
from extrap_train.geometry.cameras import pixel_grid
from extrap_train.matching import Matcher
from extrap_train.matching.mast3r import STEP, Mast3rMatcher, find_reciprocal
from extrap_train.matching.matchers import matcher

SMALL = Architecture(
    encoder_width=64,
    encoder_depth=1,
    encoder_heads=1,
    decoder_width=64,
    decoder_depth=1,
    decoder_heads=1,
)


class Colours(PointMapNetwork):
    """Describes a pixel by where its colour, red across and green down, lies: never ambiguous."""

    def __init__(self) -> None:
        torch.nn.Module.__init__(self)
        self.architecture = SMALL
        self.mask_token = torch.nn.Parameter(torch.zeros(1))

    def encode(self, images):
        return Encoding(images.flatten(1)[:, None], tuple(images.shape[-2:]))

    def describe(self, first, second):
        return self._describe(first), self._describe(second)

    def _describe(self, encoding):
        image = encoding.tokens.view(3, *encoding.grid)
        spread = torch.stack([image[0], image[1], torch.ones_like(image[0])], -1)
        return PredictedDescriptors(
            functional.normalize(spread, dim=-1)[None], torch.full((1, *encoding.grid), 3.0)
        )


@pytest.mark.parametrize("size", [(300, 400), (310, 310)])
def test_pixels_are_those_of_the_whole_pictures(size):
    """The second picture shows the first one's left half."""
    height, width = size
    grid = pixel_grid(height, width) / torch.tensor([width, height])
    first = torch.cat([grid.permute(2, 0, 1), torch.zeros(1, height, width)])
    known = torch.ones(height, width, dtype=torch.bool)
    known[: height // 2] = False
    found = Mast3rMatcher(Mast3rMatcherConfig(image_size=128), Colours())
    assert isinstance(found, Matcher)
    matches = found.match(first, first[:, :, : width // 2], known)
    assert len(matches) > 20
    assert matches.first_to_second.norm(dim=-1).median() < 4  # a pixel of 128 is 3 of theirs
    assert (matches.first[:, 1] > height // 2 - 1).all()
    assert matches.first[:, 0].max() < width / 2 + 8
    assert torch.allclose(matches.confidence, torch.tensor(0.75))


def test_the_search_finds_only_reciprocal_pairs_and_most_of_a_motion():
    torch.manual_seed(0)
    first = functional.normalize(torch.randn(40, 48, 16), dim=-1)
    second = first.roll((3, 5), (0, 1))
    ones, twos = find_reciprocal(first, second)
    similar = first.flatten(0, 1) @ second.flatten(0, 1).T
    assert (similar.argmax(1)[ones] == twos).all()
    assert (similar.argmax(0)[twos] == ones).all()
    assert len(ones) == 40 // STEP * (48 // STEP)
    # Of unrelated descriptors few are reciprocal at once; the starts move on to some that are.
    other = functional.normalize(torch.randn(40, 48, 16), dim=-1)
    ones, twos = find_reciprocal(first, other)
    similar = first.flatten(0, 1) @ other.flatten(0, 1).T
    assert (similar.argmax(1)[ones] == twos).all()
    assert (similar.argmax(0)[twos] == ones).all()
    assert len(ones) > 5


def save(architecture, path):
    torch.manual_seed(0)
    torch.save({"model": PointMapNetwork(architecture).state_dict()}, path)
    return Mast3rMatcherConfig(checkpoint=str(path), image_size=64)


def test_weights_of_a_file_match(tmp_path):
    """Untrained: it is the way from file to pixels that is tested."""
    found = matcher(save(SMALL, tmp_path / "mast3r.pth"), device=torch.device("cpu"))
    picture, _ = turned(0, 1, (0, 0), 64).pictures((48, 64))
    matches = found.match(picture, picture.flip(2))
    for pixels in (matches.first, matches.second):
        assert (pixels >= 0).all()
        assert (pixels <= torch.tensor([64, 48])).all()
    with pytest.raises(InputError, match=r"poses\.image_size=64"):
        replace(found, option="poses").match(picture[:, :4], picture)


def test_duster_has_no_descriptors(tmp_path):
    config = save(replace(SMALL, descriptor_width=None), tmp_path / "dust3r.pth")
    with pytest.raises(InputError, match=r"poses\.checkpoint=.*dust3r\.pth"):
        matcher(config, "poses")
