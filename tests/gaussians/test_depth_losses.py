"""Depth losses see through an affine map, and nothing else."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from extrap_train.gaussians.losses import (
    fill_unknown,
    normalised_patches,
    patch_depth_loss,
    patches,
    pearson,
    pearson_depth_loss,
)


def _depth(seed: int = 0) -> torch.Tensor:
    return 1 + torch.rand(24, 20, generator=torch.Generator().manual_seed(seed))


def test_pearson_is_numpys():
    a, b = _depth(0).flatten(), _depth(1).flatten()
    assert float(pearson(a, b)) == pytest.approx(np.corrcoef(a, b)[0, 1], abs=1e-6)
    assert float(pearson(a, torch.ones_like(a))) == pytest.approx(0, abs=1e-3)


@settings(max_examples=20, deadline=None)
@given(st.floats(0.1, 10), st.floats(0, 5))
def test_an_affine_map_of_the_prior_costs_nothing(scale, shift):
    depth = _depth()
    assert float(pearson_depth_loss(depth, scale * depth + shift)) == pytest.approx(0, abs=1e-4)
    for local in (True, False):
        found = normalised_patches(scale * depth + shift, 5, local)
        torch.testing.assert_close(found, normalised_patches(depth, 5, local), atol=1e-3, rtol=0)


def test_a_disparity_is_read_as_well_as_a_depth():
    depth = _depth()
    assert float(pearson_depth_loss(-1 / depth + 3, depth)) < 1e-5
    assert float(pearson_depth_loss(-depth + 9, depth)) > 1.9


def test_unknown_pixels_do_not_count():
    depth = _depth()
    prior = depth.clone()
    prior[:12] = 0
    changed = depth.clone()
    changed[:12] = 7.0
    torch.testing.assert_close(pearson_depth_loss(changed, prior), pearson_depth_loss(depth, prior))
    assert float(pearson_depth_loss(depth, torch.zeros_like(depth))) == 0


def test_patches_are_whole_and_side_by_side():
    image = torch.arange(24 * 20).reshape(24, 20).float()
    cut = patches(image, 7)
    assert cut.shape == (3 * 2, 49)
    torch.testing.assert_close(cut[3], image[7:14, 7:14].flatten())


def test_a_patch_by_hand():
    image = torch.tensor([[1.0, 3.0, 0.0, 0.0], [1.0, 3.0, 0.0, 8.0]])
    local = normalised_patches(image, 2, local=True)
    # the first patch: mean 2, deviations ±1, sample standard deviation √(4/3)
    spread = math.sqrt(4 / 3) + 0.01 * float(image.std())
    torch.testing.assert_close(local[0], torch.tensor([-1.0, 1.0, -1.0, 1.0]) / spread)
    whole = normalised_patches(image, 2, local=False)
    spread = 1.01 * float(image.std())
    torch.testing.assert_close(whole[1], torch.tensor([-2.0, -2.0, -2.0, 6.0]) / spread)


def test_small_differences_cost_nothing_and_large_ones_their_square():
    depth = _depth()
    assert float(patch_depth_loss(depth, depth + 1e-6, 5, True, tolerance=0.01)) == 0
    other = _depth(1)
    difference = normalised_patches(depth, 5, True) - normalised_patches(other, 5, True)
    beyond = difference[difference.abs() > 0.5]
    torch.testing.assert_close(
        patch_depth_loss(depth, other, 5, True, tolerance=0.5), beyond.square().mean()
    )


def test_flat_depth_has_a_finite_gradient():
    flat = torch.full((16, 16), 2.0, requires_grad=True)
    loss = patch_depth_loss(flat, _depth()[:16, :16], 5, True, 0.0)
    (loss + pearson_depth_loss(flat, _depth()[:16, :16])).backward()
    assert flat.grad.isfinite().all()


def test_filling_keeps_what_is_known_and_ends():
    prior = torch.zeros(9, 9)
    prior[0, 0], prior[8, 8] = 1.0, 3.0
    full = fill_unknown(prior)
    assert full[0, 0] == 1
    assert full[8, 8] == 3
    assert ((full >= 1) & (full <= 3)).all()
    assert not fill_unknown(torch.zeros(4, 4)).any()
