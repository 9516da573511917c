"""3-D scores against counts done by hand."""

import numpy as np
import pytest

from extrap_train.reconstruction.cloud_metrics import score_cloud, sphere_coverage

NOTHING = np.zeros((0, 3))


def line(count, offset=0.0):
    return np.c_[np.arange(count), np.full(count, offset), np.zeros(count)].astype(float)


def test_the_truth_itself_scores_perfectly():
    scores = score_cloud(line(10), line(10), NOTHING, 0.1)
    assert (scores.accuracy, scores.completeness, scores.f_score) == (1, 1, 1)
    assert scores.mean_to_truth == scores.mean_to_cloud == 0


def test_half_of_the_truth_and_as_many_wrong_points():
    cloud = np.concatenate([line(5), line(5, offset=0.5)])
    scores = score_cloud(cloud, line(10), NOTHING, 0.1)
    assert scores.accuracy == 0.5
    assert scores.completeness == 0.5
    assert scores.f_score == pytest.approx(0.5)
    assert scores.mean_to_truth == pytest.approx(0.25)


def test_the_ground_is_no_error_and_far_points_are_not_looked_at():
    ground = line(10, offset=0.5)
    cloud = np.concatenate([line(10), ground, line(10, offset=50.0)])
    assert score_cloud(cloud, line(10), ground, 0.1).accuracy == 1
    assert score_cloud(cloud, line(10), NOTHING, 0.1).accuracy == 0.5


def test_an_empty_cloud_scores_nothing():
    scores = score_cloud(NOTHING, line(10), NOTHING, 0.1)
    assert (scores.accuracy, scores.completeness, scores.f_score) == (0, 0, 0)


def test_a_cap_of_the_sphere_has_its_known_area():
    for angle in (0.3, 1.0, np.pi):
        share = sphere_coverage(np.array([[0.0, 0.6, 0.8]]), angle)
        assert share == pytest.approx((1 - np.cos(angle)) / 2, abs=0.005)
