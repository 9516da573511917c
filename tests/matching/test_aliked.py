"""The numbers on photographs: `pytest -s -m slow tests/matching/test_aliked.py`."""

import numpy as np
import pytest
import torch
from kornia.feature import ALIKED
from moved_pictures import turned
from two_views import line_distances

from extrap_train.config import AlikedMatcherConfig
from extrap_train.data.co3d import read_category
from extrap_train.errors import InputError
from extrap_train.matching import Matcher
from extrap_train.matching.matchers import matcher

NEIGHBOURS = ((0, 1), (1, 2), (2, 3), (3, 4), (4, 5), (8, 9))
"""Frames of the apple 2° to 9° apart."""


@pytest.fixture(scope="module")
def weights(shared):
    return str(shared / "weights" / "aliked-n16.pth")


def test_pixels_follow_a_crop(shared, weights):
    found = matcher(AlikedMatcherConfig(checkpoint=weights, keypoints=400))
    assert isinstance(found, Matcher)
    frame = read_category(shared / "data" / "co3d", "apple")[0].frames[0]
    first = frame.load().resized(160, 284).image
    known = torch.ones(160, 284, dtype=torch.bool)
    known[:40] = False
    matches = found.match(first, first[:, 10:, 20:], known)
    assert len(matches) > 100
    assert (matches.first[:, 1] >= 40).all()
    offset = matches.first_to_second + torch.tensor([20, 10])
    assert offset.norm(dim=-1).median() < 0.1
    assert ((matches.confidence >= 0.1) & (matches.confidence <= 1)).all()


def test_a_flat_picture_has_no_matches(weights):
    flat = torch.full((3, 64, 64), 0.5)
    first, _ = turned(0, 1, (0, 0), 64).pictures((64, 64))
    assert len(matcher(AlikedMatcherConfig(checkpoint=weights)).match(flat, first)) <= 2


def test_a_detector_of_another_size_is_refused(tmp_path):
    torch.save(ALIKED("aliked-t16").state_dict(), tmp_path / "aliked-t16.pth")
    config = AlikedMatcherConfig(checkpoint=str(tmp_path / "aliked-t16.pth"))
    with pytest.raises(InputError, match=r"aliked-t16\.pth: is another network's.*checkpoint=FILE"):
        matcher(config)


@pytest.mark.slow
def test_neighbouring_photographs_of_the_apple(shared, weights):
    found = matcher(AlikedMatcherConfig(checkpoint=weights))
    frames = read_category(shared / "data" / "co3d", "apple")[0].frames
    for i, j in NEIGHBOURS:
        first, second = frames[i].load(), frames[j].load()
        matches = found.match(first.image, second.image)
        pixels = (matches.first.numpy(), matches.second.numpy())
        error = line_distances(*pixels, first.camera, second.camera)
        print(f"{i} to {j}: {len(matches)} matches, median {np.median(error):.2f} px")
        assert len(matches) >= 300
        assert np.median(error) <= 1.5
