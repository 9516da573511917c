"""How complete and how accurate a cloud is, against a cloud of the truth."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

TOLERANCE = 0.02
"""Usual tolerance of `score_cloud`, as a share of the object's largest side."""


@dataclass(frozen=True)
class CloudScores:
    """Shares in [0, 1] at one tolerance, and mean distances in scene units."""

    accuracy: float
    """Share of the cloud's points within the tolerance of the truth (precision)."""
    completeness: float
    """Share of the truth's points within the tolerance of the cloud (recall)."""
    f_score: float
    """Harmonic mean of both."""
    mean_to_truth: float
    mean_to_cloud: float


def score_cloud(
    cloud: Float[np.ndarray, "n 3"],
    truth: Float[np.ndarray, "m 3"],
    surroundings: Float[np.ndarray, "k 3"],
    tolerance: float,
) -> CloudScores:
    """Scores of an object's cloud (Knapitsch et al., Tanks and Temples, 2017).

    `truth` lies on the object. Only points of the cloud in its bounding box, grown by a tenth of
    its largest side, are looked at, and such a point is also right on the `surroundings`: ground
    that reaches into the box is not an error. An empty cloud scores 0.
    """
    low, high = truth.min(0), truth.max(0)
    margin = 0.1 * (high - low).max()
    inside = ((cloud >= low - margin) & (cloud <= high + margin)).all(1)
    near = cloud[inside]
    if not len(near):
        return CloudScores(0.0, 0.0, 0.0, float("inf"), float("inf"))
    to_truth = cKDTree(np.concatenate([truth, surroundings])).query(near)[0]
    to_cloud = cKDTree(near).query(truth)[0]
    accuracy, completeness = (to_truth <= tolerance).mean(), (to_cloud <= tolerance).mean()
    both = accuracy + completeness
    return CloudScores(
        float(accuracy),
        float(completeness),
        float(2 * accuracy * completeness / both) if both else 0.0,
        float(to_truth.mean()),
        float(to_cloud.mean()),
    )


def sphere_coverage(directions: Float[np.ndarray, "n 3"], within_rad: float) -> float:
    """Share of all viewing directions that lie within an angle of one of these, by 2,000 probes.

    The probes are a Fibonacci lattice on the whole sphere.
    """
    count = 2000
    index = np.arange(count) + 0.5
    azimuth = np.pi * (1 + np.sqrt(5)) * index
    height = 1 - 2 * index / count
    level = np.sqrt(1 - height**2)
    probes = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), height], -1)
    return float(((probes @ directions.T).max(1) >= np.cos(within_rad)).mean())
