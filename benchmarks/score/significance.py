"""What captures tell beyond chance: the interval of a mean, and a test of paired differences.

A value is a capture's: its draws and seeds are averaged before, for they are no further samples.
"""

import math

import numpy as np
from jaxtyping import Float
from scipy import stats

CONFIDENCE = 0.95
FEWEST_CAPTURES = 6
"""With fewer the test tells nothing apart: that n signs agree by chance has a probability of
2 / 2^n, above 5 % until n is 6.
"""
_FLIPS = 4999
"""Sign patterns that are drawn where there are more; up to 12 captures all are counted."""


def mean_interval(values: Float[np.ndarray, " n"]) -> tuple[float, float]:
    """Student's t interval of the mean at 95 %; NaN for a single value, of unknown spread."""
    if len(values) < 2:
        return math.nan, math.nan
    half = stats.t.ppf((1 + CONFIDENCE) / 2, len(values) - 1) * stats.sem(values)
    return float(values.mean() - half), float(values.mean() + half)


def sign_flip_p(differences: Float[np.ndarray, " n"]) -> float:
    """p of the two-sided sign-flip test: how often the mean of paired differences would be as far
    from zero if each had the other sign as likely as its own (Fisher 1935); NaN below two.

    It needs no normal distribution. Beyond 12 captures p is of random signs, the same ones at every
    call.
    """
    if len(differences) < 2:
        return math.nan
    found = stats.permutation_test(
        (differences,),
        np.mean,
        permutation_type="samples",
        vectorized=True,
        n_resamples=_FLIPS,
        rng=np.random.default_rng(0),
    )
    return float(found.pvalue)


def is_significant(p: float) -> bool:
    """Whether a p is small enough; that of too few captures never is."""
    return p <= 1 - CONFIDENCE
