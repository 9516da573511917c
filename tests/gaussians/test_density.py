"""Growth, pruning and unpooling, by hand."""

import math

import roma
import torch

from benchmarks.methods.fsgs import unpool
from extrap_train.gaussians.density import (
    GrowthStatistics,
    grow,
    prune,
    reset_opacity,
    rotation_matrices,
    split_in_two,
)
from extrap_train.gaussians.gaussian_model import GaussianParameters
from extrap_train.gaussians.gaussian_options import GaussianOptions
from extrap_train.gaussians.optimiser import GaussianOptimiser

RATES = dict.fromkeys(("means", "log_scales", "quats", "opacity_logits", "sh_dc", "sh_rest"), 1e-2)


def _row(scales: list[float], opacity: float = 0.5, spacing: float = 1.0) -> GaussianParameters:
    """Round Gaussians along +x."""
    count = len(scales)
    return GaussianParameters(
        means=torch.tensor([[spacing * i, 0.0, 0.0] for i in range(count)]),
        log_scales=torch.tensor(scales).log()[:, None].repeat(1, 3),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1),
        opacity_logits=torch.full((count,), math.log(opacity / (1 - opacity))),
        sh_dc=torch.arange(3.0 * count).reshape(count, 1, 3) + 1,
        sh_rest=torch.zeros(count, 3, 3),
    )


def _statistics(pull: list[float]) -> GrowthStatistics:
    gradient = torch.tensor(pull)
    return GrowthStatistics(gradient, torch.ones(len(pull)))


def _generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def test_gradients_are_in_ndc_and_a_visit():
    statistics = GrowthStatistics.empty(torch.zeros(2, 3))
    gradient = torch.tensor([[3.0, 0.0], [1.0, 1.0]])
    statistics.add(gradient, torch.tensor([5.0, 0.0]), height=20, width=10)
    statistics.add(torch.tensor([[0.0, 1.0], [0.0, 0.0]]), torch.tensor([2.0, 0.0]), 20, 10)
    torch.testing.assert_close(statistics.mean_gradient(), torch.tensor([(15 + 10) / 2, 0.0]))


def test_small_ones_are_cloned_large_ones_split_and_the_rest_is_left():
    optimiser = GaussianOptimiser(_row([0.001, 0.5, 0.002]), RATES)
    statistics = _statistics([1.0, 1.0, 0.0])
    assert not grow(optimiser, statistics, GaussianOptions(), _generator())
    now = optimiser.parameters
    expected = torch.tensor([0.001, 0.002, 0.001, 0.5 / 1.6, 0.5 / 1.6])
    torch.testing.assert_close(now.scales[:, 0].detach(), expected)
    torch.testing.assert_close(now.means[2], now.means[0])
    assert len(statistics.visits) == 5


def test_only_opaque_enough_ones_grow():
    options = GaussianOptions(densify_least_opacity=0.4)
    optimiser = GaussianOptimiser(_row([0.001, 0.5], opacity=0.3), RATES)
    grow(optimiser, _statistics([1.0, 1.0]), options, _generator())
    assert len(optimiser) == 2


def test_the_limit_takes_the_strongest_and_is_reported():
    optimiser = GaussianOptimiser(_row([0.001] * 4), RATES)
    options = GaussianOptions(max_gaussians=6)
    assert grow(optimiser, _statistics([0.1, 0.4, 0.3, 0.2]), options, _generator())
    torch.testing.assert_close(optimiser.parameters.means[4:, 0].detach(), torch.tensor([1.0, 2]))
    assert grow(optimiser, _statistics([1.0] * 6), options, _generator())
    assert len(optimiser) == 6


def test_halves_are_drawn_from_the_whole():
    """Along the axes of a turned, flat Gaussian, over many draws."""
    count = 4000
    one = _row([1.0])
    scales, quat = torch.tensor([[2.0, 0.5, 0.1]]), torch.tensor([[0.8, 0.1, -0.4, 0.2]])
    many = GaussianParameters(
        **{name: value.repeat(count, *[1] * (value.dim() - 1)) for name, value in vars(one).items()}
        | {"log_scales": scales.log().repeat(count, 1), "quats": 3 * quat.repeat(count, 1)}
    )
    halves = split_in_two(many, _generator())
    rotation = roma.unitquat_to_rotmat(torch.nn.functional.normalize(quat, dim=1)[:, [1, 2, 3, 0]])[
        0
    ]
    found = torch.cov(halves.means.T)
    torch.testing.assert_close(
        found, rotation @ torch.diag(scales[0].square()) @ rotation.T, atol=0.12, rtol=0
    )
    torch.testing.assert_close(halves.scales, (scales / 1.6).expand(2 * count, 3))


def test_rotations_are_romas():
    quats = torch.randn(10, 4, generator=_generator())
    unit = torch.nn.functional.normalize(quats, dim=1)
    expected = roma.unitquat_to_rotmat(unit[:, [1, 2, 3, 0]])
    torch.testing.assert_close(rotation_matrices(quats), expected)


def test_pruning_takes_the_transparent_and_later_the_large():
    parameters = _row([0.01, 0.01, 0.5])
    parameters.opacity_logits[1] = -9.0
    for large_too, left in ((False, 2), (True, 1)):
        optimiser = GaussianOptimiser(parameters, RATES)
        prune(optimiser, _statistics([0.0] * 3), GaussianOptions(prune_scale=0.1), large_too)
        assert len(optimiser) == left


def test_pruning_leaves_one():
    optimiser = GaussianOptimiser(_row([0.01, 0.01], opacity=0.001), RATES)
    prune(optimiser, _statistics([0.0] * 2), GaussianOptions(), large_too=False)
    assert len(optimiser) == 1


def test_opacity_is_capped_and_not_raised():
    parameters = _row([0.1, 0.1])
    parameters.opacity_logits[1] = -9.0
    optimiser = GaussianOptimiser(parameters, RATES)
    reset_opacity(optimiser, 0.01)
    found = optimiser.parameters.opacities.detach()
    torch.testing.assert_close(found, torch.tensor([0.01, 1 / (1 + math.exp(9))]))


def test_unpooling_puts_copies_of_the_neighbour_half_way():
    # distances of the first Gaussian to its three neighbours: 1, 2, 3
    parameters = _row([0.5, 0.01, 0.01, 0.01])
    new, limited = unpool(parameters, proximity=1.0, scale=0.1, most=100)
    assert not limited
    torch.testing.assert_close(new.means[:, 0], torch.tensor([0.5, 1.0, 1.5]))
    torch.testing.assert_close(new.scales, torch.full((3, 3), 0.01))
    torch.testing.assert_close(new.opacities, torch.full((3,), 0.5))
    assert not new.sh_dc.any()
    assert len(unpool(parameters, 100.0, 0.1, most=100)[0]) == 0
    assert len(unpool(parameters, 1.0, 0.9, most=100)[0]) == 0


def test_where_room_is_short_the_most_isolated_are_unpooled_and_the_cut_is_told():
    parameters = _row([0.5, 0.5, 0.5, 0.5])
    parameters.means[3, 0] = 10.0  # its three neighbours are the farthest
    new, limited = unpool(parameters, proximity=1.0, scale=0.1, most=3)
    torch.testing.assert_close(new.means[:, 0], torch.tensor([6.0, 5.5, 5.0]))
    assert limited
    assert not unpool(parameters, proximity=50.0, scale=0.1, most=9)[1]
