import numpy as np
import torch

from extrap_train.depth.monocular import robust_line


def sample(outliers: float, noise: float, count: int = 300):
    generator = torch.Generator().manual_seed(0)
    x = 4 * torch.rand(count, generator=generator)
    y = 0.7 * x + 0.2 + noise * torch.randn(count, generator=generator)
    wrong = torch.rand(count, generator=generator) < outliers
    return x, torch.where(wrong, 6 * torch.rand(count, generator=generator), y)


def test_a_line_is_found_exactly():
    line = robust_line(*sample(0, 0), torch.ones(300))
    assert abs(line.slope - 0.7) < 1e-6
    assert abs(line.offset - 0.2) < 1e-6


def test_four_in_ten_wrong_points_do_not_bend_it():
    x, y = sample(0.4, 0.01)
    line = robust_line(x, y, torch.ones(300))
    assert abs(line.slope - 0.7) < 0.01
    assert abs(line.offset - 0.2) < 0.02
    bent = np.polyfit(x.numpy(), y.numpy(), 1)
    assert abs(bent[0] - 0.7) > 0.1


def test_without_outliers_it_is_nearly_least_squares():
    x, y = sample(0, 0.05)
    line = robust_line(x, y, torch.ones(300))
    slope, offset = np.polyfit(x.numpy(), y.numpy(), 1)
    assert abs(line.slope - slope) < 0.003
    assert abs(line.offset - offset) < 0.006


def test_weights_choose_between_two_lines():
    x = torch.linspace(0, 1, 100)
    y = torch.cat([x[:40] * 2, x[40:] + 5])
    line = robust_line(x, y, torch.where(torch.arange(100) < 40, 1e-6, 1.0))
    assert abs(line.slope - 1) < 1e-3


def test_no_line_through_one_value():
    assert robust_line(torch.ones(9), torch.rand(9), torch.ones(9)) is None
    assert robust_line(torch.ones(1), torch.ones(1), torch.ones(1)) is None
