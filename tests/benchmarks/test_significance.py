"""Intervals and the test against independent oracles, and how often they are wrong."""

import itertools
import math

import numpy as np
import pytest
from scipy import stats

from benchmarks.report.aggregate import (
    FEWEST_CAPTURES,
    is_significant,
    mean_interval,
    sign_flip_p,
)


def test_the_interval_is_students() -> None:
    low, high = mean_interval(np.array([1.0, 2.0, 6.0]))
    half = 4.30265 * math.sqrt(7 / 3)  # the tables' t of two degrees of freedom
    assert (low, high) == pytest.approx((3 - half, 3 + half), rel=1e-5)
    values = np.random.default_rng(0).normal(5.0, 2.0, 400)
    oracle = stats.ttest_1samp(values, 0.0).confidence_interval(0.95)
    assert mean_interval(values) == pytest.approx((oracle.low, oracle.high))
    assert mean_interval(np.array([2.0, 2.0])) == (2.0, 2.0)
    assert all(map(math.isnan, mean_interval(np.array([3.0]))))


@pytest.mark.parametrize("count", [2, 4, 6, 24])
def test_an_interval_holds_the_true_mean_as_often_as_it_says(count: int) -> None:
    rng = np.random.default_rng(count)
    held = [
        low <= 5.0 <= high
        for low, high in (mean_interval(rng.normal(5.0, 2.0, count)) for _ in range(500))
    ]
    assert np.mean(held) == pytest.approx(0.95, abs=0.03)


@pytest.mark.parametrize("count", [2, 5, 6, 9])
def test_the_test_counts_every_sign_pattern(count: int) -> None:
    """Against plain counting; single digits, so that equal sums are met and count as far."""
    values = np.random.default_rng(count).integers(-4, 9, count).astype(float)
    signs = itertools.product([-1, 1], repeat=count)
    far = [abs(np.dot(sign, values)) >= abs(values.sum()) for sign in signs]
    assert sign_flip_p(values) == pytest.approx(min(1.0, np.mean(far)))


def test_below_six_captures_nothing_is_significant() -> None:
    agreeing = np.arange(1.0, 10.0)
    for count in range(1, 10):
        found = is_significant(sign_flip_p(agreeing[:count]))
        assert found == (count >= FEWEST_CAPTURES)


@pytest.mark.parametrize("draw", ["normal", "sparse"])
@pytest.mark.parametrize(("count", "expected"), [(2, 0.0), (4, 0.0), (6, 2 / 2**6), (24, 0.05)])
def test_false_alarms(count: int, expected: float, draw: str) -> None:
    """Methods that are the same: no more than one in twenty is told apart, of differences that are
    normal and of those that are mostly none, as shares are.
    """
    rng = np.random.default_rng(count)
    trials = rng.normal(0.0, 1.0, (200, count))
    if draw == "sparse":
        trials = np.sign(trials) * (rng.random((200, count)) < 0.25)
    rate = np.mean([is_significant(sign_flip_p(differences)) for differences in trials])
    if draw == "normal":
        assert rate == pytest.approx(expected, abs=0.03 if expected else 0.0)
    else:
        assert rate <= expected


def test_a_true_difference_is_found() -> None:
    trials = np.random.default_rng(0).normal(1.0, 1.0, (100, 24))
    assert np.mean([is_significant(sign_flip_p(differences)) for differences in trials]) > 0.95
    assert sign_flip_p(trials[0]) == sign_flip_p(trials[0])
    assert sign_flip_p(np.zeros(24)) == 1.0
