"""Guidance by hand: its weights over angles, its interval, and its rescaling."""

import math

import pytest
import torch
from batches import batch_of

from extrap_train.config import SamplerConfig
from extrap_train.diffusion.guidance import acts, guidance_weights, guided


def test_guidance_grows_with_the_angle_to_the_nearest_reference() -> None:
    """The fixture's nearest reference is 0.3 rad away."""
    batch = batch_of(2)
    assert guidance_weights(batch, SamplerConfig(guidance=3.0)).tolist() == [3.0, 3.0]
    growing = SamplerConfig(guidance=1.0, guidance_far=5.0, guidance_far_deg=60.0)
    expected = 1 + 4 * 0.3 / math.radians(60)
    assert guidance_weights(batch, growing).tolist() == pytest.approx([expected] * 2, rel=1e-4)
    soon = SamplerConfig(guidance=1.0, guidance_far=5.0, guidance_far_deg=10.0)
    assert guidance_weights(batch, soon).tolist() == pytest.approx([5.0, 5.0])


def test_guidance_acts_inside_its_interval_alone() -> None:
    options = SamplerConfig(guidance_interval=[0.2, 0.7])
    assert [acts(share, options) for share in (0.1, 0.2, 0.5, 0.7, 0.9)] == [
        False,
        True,
        True,
        True,
        False,
    ]


def test_rescaling_gives_the_conditionals_spread_back() -> None:
    generator = torch.Generator().manual_seed(0)
    conditional, null = torch.randn(2, 2, 3, 4, 4, generator=generator)
    weights = torch.tensor([1.0, 4.0])
    plain = guided(conditional, null, weights, 0.0)
    torch.testing.assert_close(plain[0], conditional[0])
    torch.testing.assert_close(plain[1], 4 * conditional[1] - 3 * null[1])
    whole = guided(conditional, null, weights, 1.0)
    torch.testing.assert_close(whole.std((1, 2, 3)), conditional.std((1, 2, 3)))
    half = guided(conditional, null, weights, 0.5)
    torch.testing.assert_close(half, (plain + whole) / 2)
