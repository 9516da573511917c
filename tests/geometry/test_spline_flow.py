"""Smooth fields: the splines against scipy's, the fit against known motions and wrong matches."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import BSpline

from extrap_train.geometry.spline_flow import bspline_basis, dense_flow, fit_flow, flow_at


def scattered(count: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(count, 2, generator=torch.Generator().manual_seed(seed)) * 2 - 1


def bent(positions: torch.Tensor) -> torch.Tensor:
    u, v = positions.unbind(-1)
    return torch.stack([0.05 * torch.sin(2 * u + v), 0.03 * u * v - 0.02], -1)


def test_the_basis_is_that_of_cubic_splines() -> None:
    at, count = np.linspace(-0.999, 0.999, 50), 7
    knots = (np.arange(count + 4) - 3) * 2 / (count - 3) - 1
    expected = BSpline(knots, np.eye(count), 3)(at)
    found = bspline_basis(torch.from_numpy(at), count)
    np.testing.assert_allclose(found, expected, atol=1e-12)


@given(grid=st.integers(4, 16), step=st.tuples(*2 * [st.floats(-0.5, 0.5)]))
@settings(max_examples=20, deadline=None)
def test_equal_control_vectors_move_everything_alike(grid: int, step) -> None:
    control = torch.tensor(step).view(2, 1, 1).expand(2, grid, grid)
    field = dense_flow(control, 5, 9)
    torch.testing.assert_close(field, control[:, :1, :1].expand(2, 5, 9), atol=1e-6, rtol=0)


def test_the_dense_field_is_the_field_at_the_pixel_centres() -> None:
    control = torch.randn(2, 6, 6, generator=torch.Generator().manual_seed(1))
    v, u = torch.meshgrid(
        (torch.arange(5) + 0.5) / 2.5 - 1, (torch.arange(8) + 0.5) / 4 - 1, indexing="ij"
    )
    at_centres = flow_at(control, torch.stack([u, v], -1).reshape(-1, 2))
    torch.testing.assert_close(dense_flow(control, 5, 8).reshape(2, -1).mT, at_centres)


def test_a_smooth_motion_is_found_among_wrong_matches() -> None:
    positions = scattered(800)
    noise = torch.randn(800, 2, generator=torch.Generator().manual_seed(2))
    steps = bent(positions) + 0.001 * noise
    wrong = torch.zeros(800, dtype=torch.bool)
    wrong[::5] = True
    wrong |= (positions > 0.6).all(1)  # and a whole corner of them, all alike
    steps[wrong] += torch.tensor([0.2, -0.15])
    control, inliers = fit_flow(positions, steps, torch.ones(800), 8)
    assert not (inliers & wrong).any()
    assert inliers[~wrong].float().mean() > 0.9
    elsewhere = scattered(300, 3)
    elsewhere = elsewhere[~(elsewhere > 0.5).all(1)]
    error = (flow_at(control, elsewhere) - bent(elsewhere)).norm(dim=1)
    assert error.median() < 1e-3
    assert error.max() < 0.02, "beside the corner of wrong ones, which are off by 0.25"


def test_where_no_match_is_the_field_runs_on_evenly() -> None:
    positions = scattered(300)
    positions = positions[positions[:, 0] < 0]
    steps = 0.1 * positions @ torch.tensor([[1.0, 0.5], [0.0, 1.0]])
    control, _ = fit_flow(positions, steps, torch.ones(len(positions)), 8)
    right = torch.tensor([[0.9, 0.0], [0.5, 0.5]])
    torch.testing.assert_close(
        flow_at(control, right),
        0.1 * right @ torch.tensor([[1.0, 0.5], [0.0, 1.0]]),
        atol=5e-3,
        rtol=0,
    )


def test_nothing_to_fit_is_no_field() -> None:
    with pytest.raises(ValueError, match="no displacements"):
        fit_flow(torch.zeros(0, 2), torch.zeros(0, 2), torch.zeros(0), 8)
