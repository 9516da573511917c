"""Averages chosen afterwards are those that training would have kept."""

import pytest
import torch

from extrap_train.diffusion.power_average import Profile, decay_at, exponent_of, mixture

WIDTHS = (0.05, 0.1)


def averaged(values: list[float], exponent: float) -> list[float]:
    """The running average after each value."""
    mean, seen = 0.0, []
    for step, value in enumerate(values, 1):
        keep = decay_at(step, exponent)
        mean = keep * mean + (1 - keep) * value
        seen.append(mean)
    return seen


@pytest.mark.parametrize("width", [0.01, 0.05, 0.1, 0.25])
def test_width_is_the_profiles_standard_deviation(width: float) -> None:
    exponent = exponent_of(width)
    time = (torch.arange(200_000, dtype=torch.float64) + 0.5) / 200_000
    profile = time**exponent / (time**exponent).sum()
    mean = (profile * time).sum()
    assert float((profile * (time - mean).square()).sum().sqrt()) == pytest.approx(width, rel=1e-4)


def test_published_exponents() -> None:
    assert exponent_of(0.05) == pytest.approx(16.97, abs=0.01)
    assert exponent_of(0.10) == pytest.approx(6.94, abs=0.01)


def test_running_average_weighs_by_the_power_of_time() -> None:
    values = torch.rand(400, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    time = torch.arange(1, 401, dtype=torch.float64)
    for exponent in (0.0, 3.0, 17.0):
        # What a step adds to t^(γ + 1), in place of its derivative.
        weight = time ** (exponent + 1) - (time - 1) ** (exponent + 1)
        exact = float((weight * values).sum() / weight.sum())
        assert averaged(values.tolist(), exponent)[-1] == pytest.approx(exact, rel=1e-9)


def test_a_snapshot_is_itself() -> None:
    snapshots = [Profile(s, exponent_of(w)) for s in (100, 200, 300) for w in WIDTHS]
    for index, profile in enumerate(snapshots):
        shares = mixture(snapshots, profile)
        assert torch.allclose(shares, torch.eye(6, dtype=torch.float64)[index], atol=1e-6)


@pytest.mark.parametrize("width", [0.03, 0.07, 0.15])
def test_other_widths_come_out_of_the_snapshots(width: float) -> None:
    """A slowly drifting weight with noise, against the average that was kept all along."""
    generator = torch.Generator().manual_seed(0)
    drift = torch.linspace(0, 3, 1200).sin() + 0.3 * torch.randn(1200, generator=generator)
    values = drift.tolist()
    every = range(100, 1201, 100)
    running = {w: averaged(values, exponent_of(w)) for w in WIDTHS}
    snapshots = [Profile(step, exponent_of(w)) for step in every for w in WIDTHS]
    kept = torch.tensor([running[w][step - 1] for step in every for w in WIDTHS])
    shares = mixture(snapshots, Profile(1200, exponent_of(width)))
    direct = averaged(values, exponent_of(width))[-1]
    assert float(shares.sum()) == pytest.approx(1, abs=0.02)
    assert float(shares.float() @ kept) == pytest.approx(direct, abs=0.02)
