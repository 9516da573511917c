import cv2
import numpy as np
import pytest
import torch

from extrap_train.matching.sift import (
    Features,
    descriptor_distance,
    detect_sift,
    match_mutual,
    root_sift,
)


@pytest.fixture(scope="module")
def picture() -> torch.Tensor:
    noise = torch.rand(3, 24, 24, generator=torch.Generator().manual_seed(0))
    return torch.nn.functional.interpolate(noise[None], (96, 96), mode="bicubic")[0].clamp(0, 1)


def test_matches_of_a_shifted_picture_are_shifted_by_as_much(picture):
    first, second = detect_sift(picture), detect_sift(picture.roll((5, 3), (1, 2)))
    pairs = match_mutual(descriptor_distance(first, second), 0.8)
    assert len(pairs) > 20
    moved = second.pixels[pairs[:, 1]] - first.pixels[pairs[:, 0]]
    np.testing.assert_allclose(np.median(moved, 0), (3, 5), atol=0.05)


def test_pixels_are_those_of_the_given_picture_at_any_working_size(picture):
    own, enlarged = detect_sift(picture), detect_sift(picture, (192, 288))
    pairs = match_mutual(descriptor_distance(own, enlarged), 0.9)
    apart = enlarged.pixels[pairs[:, 1]] - own.pixels[pairs[:, 0]]
    assert len(pairs) > 5
    # OpenCV's SIFT is off by a quarter of a pixel of the picture that it works on.
    assert np.linalg.norm(np.median(apart, 0)) < 0.3


def test_mutual_matches_are_opencvs_in_both_directions(picture):
    first, second = detect_sift(picture), detect_sift(picture.flip(2).roll(2, 1) * 0.9 + 0.05)
    matcher = cv2.BFMatcher(cv2.NORM_L2)

    def best(query: np.ndarray, train: np.ndarray) -> dict[int, int]:
        pairs = matcher.knnMatch(query, train, k=2)
        return {a.queryIdx: a.trainIdx for a, b in pairs if a.distance <= 0.9 * b.distance}

    there = best(first.descriptors, second.descriptors)
    back = best(second.descriptors, first.descriptors)
    expected = [(a, b) for a, b in there.items() if back.get(b) == a]
    found = match_mutual(descriptor_distance(first, second), 0.9)
    assert sorted(map(tuple, found.tolist())) == sorted(expected)


def test_excluded_and_missing_features_match_nothing():
    blank = detect_sift(torch.full((3, 32, 32), 0.5))
    assert len(blank.pixels) == 0
    assert len(match_mutual(descriptor_distance(blank, blank), 0.8)) == 0
    assert len(match_mutual(np.full((3, 4), np.inf), 0.8)) == 0
    assert match_mutual(np.array([[0.1]]), 0.8).tolist() == [[0, 0]]


def test_root_sift_has_unit_length(picture):
    found = root_sift(detect_sift(picture))
    np.testing.assert_allclose(np.linalg.norm(found.descriptors, axis=1), 1, atol=1e-5)
    empty = root_sift(Features(np.zeros((0, 2)), np.zeros((0, 128), np.float32)))
    assert len(empty.descriptors) == 0
