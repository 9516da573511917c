from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from orbits import even, ring

from data_prep.select import pair_score, select_pairs
from extrap_train.config import PrepConfig
from extrap_train.geometry.viewpoints import pairwise_angles, scene_center


def angles_of(azimuths_deg: np.ndarray) -> np.ndarray:
    camera = ring(azimuths_deg)
    return pairwise_angles(camera, scene_center(camera))


def naive_greedy(angles: np.ndarray, options: PrepConfig) -> list[tuple[int, int]]:
    """Word by word from the description, in the slowest way."""
    degrees = np.degrees(angles)
    candidates = []
    for i in range(len(angles)):
        for j in range(i + 1, len(angles)):
            if options.min_pair_angle_deg <= degrees[i, j] <= options.max_pair_angle_deg:
                score = np.cos(angles[i, j]) * (1 - np.cos(angles[i, j]))
                candidates.append((-round(score * 1e6), i, j))
    uses = [0] * len(angles)
    chosen: list[tuple[int, int]] = []
    for _, i, j in sorted(candidates):
        if max(uses[i], uses[j]) >= options.max_uses:
            continue
        limit = options.near_duplicate_deg
        straight = any(max(degrees[i, p], degrees[j, q]) < limit for p, q in chosen)
        crossed = any(max(degrees[i, q], degrees[j, p]) < limit for p, q in chosen)
        if not straight and not crossed:
            chosen.append((i, j))
            uses[i] += 1
            uses[j] += 1
    return chosen


def test_the_score_is_largest_at_sixty_degrees() -> None:
    degrees = np.arange(0.0, 91.0)
    score = pair_score(np.radians(degrees))
    assert degrees[score.argmax()] == 60
    assert score.max() == pytest.approx(0.25)
    np.testing.assert_allclose(score[[0, 90]], 0, atol=1e-12)


@given(
    st.integers(0, 10_000),
    st.integers(2, 30),
    st.integers(1, 12),
    st.sampled_from([0.1, 6.0, 20.0]),
)
@settings(max_examples=40, deadline=None)
def test_the_greedy_choice_is_the_naive_one(
    seed: int, frames: int, max_uses: int, near_deg: float
) -> None:
    azimuths = np.random.default_rng(seed).uniform(0, 360, frames)
    options = replace(PrepConfig(), max_uses=max_uses, near_duplicate_deg=near_deg)
    angles = angles_of(azimuths)
    chosen = select_pairs(angles, options)
    pairs = list(zip(chosen.reference.tolist(), chosen.query.tolist(), strict=True))
    assert pairs[::2] == naive_greedy(angles, options)
    assert pairs[1::2] == [(query, reference) for reference, query in pairs[::2]]


def test_ties_go_to_the_lower_index_whatever_the_rounding() -> None:
    angles = angles_of(even(12))
    noise = np.random.default_rng(0).normal(size=angles.shape) * 1e-9
    options = replace(PrepConfig(), max_uses=1)
    chosen, noisy = select_pairs(angles, options), select_pairs(angles + noise + noise.T, options)
    np.testing.assert_array_equal(chosen.reference, noisy.reference)
    np.testing.assert_array_equal(chosen.query, noisy.query)


def test_queries_and_references_are_respected() -> None:
    angles = angles_of(even(20))
    queries = np.arange(20) % 5 == 4
    chosen = select_pairs(angles, PrepConfig(), queries, ~queries)
    assert len(chosen.query)
    assert queries[chosen.query].all()
    assert not queries[chosen.reference].any()


@pytest.mark.parametrize("frames", [24, 60, 100, 200])
def test_default_options_give_every_difficulty(frames: int) -> None:
    """Nearest-reference angles reach from 15° to 85°, and the middle is well filled."""
    jitter = np.random.default_rng(1).normal(size=frames)
    chosen = select_pairs(angles_of(even(frames) + jitter), PrepConfig())
    degrees = np.degrees(chosen.angle_rad)
    assert (degrees < 25).mean() > 0.03
    assert (degrees > 75).mean() > 0.03
    assert ((degrees > 40) & (degrees < 75)).mean() > 0.4


def test_no_pair_where_nothing_is_within_reach() -> None:
    assert len(select_pairs(angles_of(np.array([0.0, 150.0])), PrepConfig()).query) == 0
