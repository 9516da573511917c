"""Gaussians from points, and an optimiser whose moments follow them."""

import math

import pytest
import torch
from scipy.spatial import KDTree

from extrap_train.errors import InputError
from extrap_train.gaussians.gaussian_model import GaussianParameters
from extrap_train.gaussians.gaussian_options import Schedule, exponential
from extrap_train.gaussians.init import (
    Points,
    nearest_neighbours,
    parameters_from_points,
    random_points,
)
from extrap_train.gaussians.optimiser import GaussianOptimiser
from extrap_train.geometry.cameras import project
from tests.scenes import orbit_camera

RATES = dict.fromkeys(("means", "log_scales", "quats", "opacity_logits", "sh_dc", "sh_rest"), 1e-2)


def _points(count: int = 30) -> Points:
    generator = torch.Generator().manual_seed(3)
    drawn = torch.rand(2, count, 3, generator=generator)
    return Points(drawn[0], drawn[1], torch.ones(count))


def _parameters(count: int = 30) -> GaussianParameters:
    return parameters_from_points(_points(count), sh_degree=2, opacity=0.1)


def test_start_is_the_published_one():
    points = _points()
    start = parameters_from_points(points, sh_degree=2, opacity=0.1)
    distance, _ = KDTree(points.positions).query(points.positions, k=4)
    expected = torch.from_numpy(distance[:, 1:]).float().square().mean(1).sqrt()
    torch.testing.assert_close(start.scales, expected[:, None].expand(-1, 3))
    torch.testing.assert_close(start.opacities, torch.full((30,), 0.1))
    values = start.gaussians()
    torch.testing.assert_close(0.5 + values.sh[:, 0] / (2 * math.sqrt(math.pi)), points.colors)
    assert values.sh_degree == 2
    assert not values.sh[:, 1:].any()


def test_one_point_is_enough():
    assert len(_parameters(1)) == 1
    assert _parameters(1).scales.isfinite().all()
    distance, index = nearest_neighbours(_points(2).positions, 3)
    assert distance.shape == (2, 1)
    assert index.flatten().tolist() == [1, 0]


def test_no_point_and_a_nan_are_refused():
    with pytest.raises(InputError, match="no initial points"):
        _parameters(0)
    broken = _points()
    broken.positions[4, 1] = float("nan")
    with pytest.raises(InputError, match="not finite"):
        parameters_from_points(broken, 0, 0.1)


def test_random_points_are_all_seen():
    cameras = [orbit_camera(azimuth) for azimuth in (0, 120)]
    points = random_points(cameras, 200, torch.Generator().manual_seed(0))
    seen = torch.zeros(200, dtype=torch.bool)
    for camera in cameras:
        pixels, depth = project(points.positions, camera)
        inside = ((pixels >= 0) & (pixels <= camera.width)).all(1)
        seen |= inside & (depth > 0)
    assert seen.all()


def _loss(parameters: GaussianParameters, target: torch.Tensor) -> torch.Tensor:
    spread = parameters.log_scales.sum() + parameters.sh_rest.square().sum()
    return (parameters.means - target).square().sum() + spread


def test_it_is_adam():
    start, target = _parameters(), torch.ones(3)
    optimiser = GaussianOptimiser(start, RATES)
    mine = start.means.clone().requires_grad_()
    plain = torch.optim.Adam([mine], lr=1e-2, eps=1e-15)
    for _ in range(5):
        _loss(optimiser.parameters, target).backward()
        optimiser.step()
        plain.zero_grad()
        (mine - target).square().sum().backward()
        plain.step()
    torch.testing.assert_close(optimiser.parameters.means.detach(), mine.detach())


def test_rows_that_stay_move_as_if_nothing_had_happened():
    """Growing and pruning others must not disturb a Gaussian's own moments."""
    start, target = _parameters(), torch.ones(3)
    alone, changed = GaussianOptimiser(start, RATES), GaussianOptimiser(start, RATES)
    kept = torch.arange(30) % 3 > 0
    for step in range(6):
        for optimiser in (alone, changed):
            _loss(optimiser.parameters, target).backward()
            optimiser.step()
        if step == 2:
            changed.append(_parameters(4))
            changed.keep(torch.cat([kept, torch.ones(4, dtype=torch.bool)]))
    for name, value in alone.parameters.tensors().items():
        torch.testing.assert_close(changed.parameters.tensors()[name][:-4], value[kept])
    assert len(changed) == int(kept.sum()) + 4


def test_parameters_without_a_gradient_stay():
    optimiser = GaussianOptimiser(_parameters(), RATES)
    before = optimiser.parameters.opacity_logits.detach().clone()
    optimiser.parameters.means.sum().backward()
    optimiser.step()
    assert optimiser.parameters.opacity_logits.equal(before)


def test_each_mean_takes_its_share_of_the_step():
    start, factor = _parameters(), torch.linspace(0, 2, 30)[:, None]
    plain, shared = GaussianOptimiser(start, RATES), GaussianOptimiser(start, RATES)
    for optimiser, factors in ((plain, None), (shared, factor)):
        optimiser.parameters.means.sum().backward()
        optimiser.step(factors)
    moved = plain.parameters.means.detach() - start.means
    torch.testing.assert_close(
        shared.parameters.means.detach() - start.means, factor * moved, atol=1e-6, rtol=0
    )


def test_schedules_shrink_in_proportion():
    schedule = Schedule(iterations=1000, full_iterations=30_000)
    assert schedule.at(15_000) == 500
    assert schedule.rate_factor == pytest.approx(math.sqrt(30))
    assert Schedule(30_000, 30_000).rate_factor == 1
    due = [i for i in range(1, 200) if schedule.due(i, 900, 600, least=1)]
    assert due[:3] == [30, 50, 70]
    assert not any(schedule.due(i, 900, 0, least=1) for i in range(100))
    assert [i for i in range(60) if schedule.due(i, 0, 30, least=25)] == [1, 26, 51]


def test_rates_fall_evenly_in_the_logarithm():
    assert exponential(1e-2, 1e-4, 0.5) == pytest.approx(1e-3)
    assert exponential(1e-2, 1e-4, 2.0) == pytest.approx(1e-4)
