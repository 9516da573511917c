import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from moved_pictures import Motion, texture, turned
from two_views import line_distances

from extrap_train.config import FlowMatcherConfig
from extrap_train.data.co3d import read_category
from extrap_train.geometry.cameras import pixel_grid
from extrap_train.matching import Matcher, Matches
from extrap_train.matching.matchers import matcher

FLOW = matcher(FlowMatcherConfig())
MOTIONS = {
    "shift": lambda size: turned(0, 1, (0.04 * size, -0.03 * size), size),
    "turn": lambda size: turned(0.07, 1, (0, 0), size),
    "growth": lambda size: turned(0, 1.08, (0.7, 0.3), size),
}


def errors(matches: Matches, motion: Motion) -> torch.Tensor:
    """How far, in pixels, each match is from the truth."""
    return (matches.second - motion(matches.first)).norm(dim=-1)


@pytest.mark.parametrize("size", [64, 128, 256])
@pytest.mark.parametrize("name", MOTIONS)
def test_a_known_motion_is_found_to_a_fraction_of_a_pixel(name, size):
    motion = MOTIONS[name](size)
    matches = FLOW.match(*motion.pictures((size, size)))
    found = errors(matches, motion)
    assert len(matches) > 0.75 * size**2
    assert found.median() < 0.1
    assert found.quantile(0.95) < 0.5


def test_direction_and_pixel_centres():
    first, second = torch.zeros(2, 3, 64, 64)
    first[:, 20:24, 30:34], second[:, 22:26, 35:39] = 1, 1  # two down, five to the right
    flow = FLOW.flow(first, second)
    moved = flow.first_to_second[20:24, 30:34]
    torch.testing.assert_close(moved.mean((0, 1)), torch.tensor([5.0, 2.0]), atol=0.3, rtol=0)


def test_exposure_and_noise_change_little():
    motion = MOTIONS["shift"](128)
    first, second = motion.pictures((128, 128))
    noise = 0.02 * torch.randn(second.shape, generator=torch.Generator().manual_seed(0))
    found = errors(FLOW.match(first, (0.8 * second + 0.05 + noise).clamp(0, 1)), motion)
    assert found.median() < 0.25
    assert found.quantile(0.95) < 1


def test_holes_start_no_match_and_spoil_none():
    motion = MOTIONS["turn"](128)
    first, second = motion.pictures((128, 128))
    known = torch.ones(128, 128, dtype=torch.bool)
    known[30:60, 40:90] = False
    known &= torch.rand(128, 128, generator=torch.Generator().manual_seed(0)) > 0.05
    matches = FLOW.match(first * known, second, known)
    u, v = matches.first.floor().long().unbind(-1)
    assert known[v, u].all()
    assert len(matches) > 0.5 * known.sum()
    assert errors(matches, motion).median() < 0.2


def test_pictures_of_different_size():
    motion = turned(0, 1, (-6.0, -4.0), 128)
    first, second = motion.pictures((128, 128), (96, 112))
    flow = FLOW.flow(first, second)
    landed = pixel_grid(128, 128) + flow.first_to_second
    outside = (landed < 0).any(-1) | (landed[..., 0] > 112) | (landed[..., 1] > 96)
    assert (flow.confidence[outside] == 0).all()
    matches = flow.matches()
    assert len(matches) > 0.75 * 96 * 112
    assert errors(matches, motion).median() < 0.1


def test_strangers_match_nowhere_surely():
    first = texture(pixel_grid(128, 128)).permute(2, 0, 1)
    stranger = texture(pixel_grid(128, 128), seed=1).permute(2, 0, 1)
    assert (FLOW.flow(first, stranger).confidence > 0.5).float().mean() < 0.05


def test_a_picture_without_texture_has_no_matches():
    flat = torch.full((3, 64, 64), 0.4)
    assert len(FLOW.match(flat, flat)) == 0


def test_matches_are_the_pixels_whose_way_is_known():
    motion = MOTIONS["shift"](64)
    flow = FLOW.flow(*motion.pictures((64, 64)))
    matches = flow.matches()
    assert len(matches) == (flow.confidence > 0).sum() < 64 * 64
    u, v = matches.first.floor().long().unbind(-1)
    torch.testing.assert_close(matches.first_to_second, flow.first_to_second[v, u])
    torch.testing.assert_close(matches.confidence, flow.confidence[v, u])


@pytest.mark.parametrize(("i", "j"), [(1, 2), (2, 3), (8, 9)])
def test_neighbouring_photographs_of_the_apple(shared, i, j):
    frames = read_category(shared / "data" / "co3d", "apple")[0].frames
    first, second = (frames[k].load().resized(512, 288) for k in (i, j))
    matches = FLOW.match(first.image, second.image)
    matches = matches[matches.confidence > 0.5]
    pixels = (matches.first.numpy(), matches.second.numpy())
    error = line_distances(*pixels, first.camera, second.camera)
    share = len(matches) / (512 * 288)
    print(f"{i} to {j}: {share:.0%} of the pixels, median {np.median(error):.2f} px")
    assert share > 0.4
    assert np.median(error) < 0.3
    assert np.quantile(error, 0.9) < 0.8


@settings(max_examples=15, deadline=None)
@given(st.integers(1, 40), st.integers(1, 40), st.integers(1, 40), st.integers(1, 40))
def test_any_size_gives_a_finite_flow(height, width, second_height, second_width):
    first = texture(pixel_grid(height, width)).permute(2, 0, 1)
    second = texture(pixel_grid(second_height, second_width)).permute(2, 0, 1)
    flow = FLOW.flow(first, second)
    assert flow.first_to_second.isfinite().all()
    assert ((flow.confidence >= 0) & (flow.confidence <= 1)).all()


def test_it_is_a_matcher():
    assert isinstance(FLOW, Matcher)
