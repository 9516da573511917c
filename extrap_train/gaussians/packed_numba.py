"""Ellipses side by side as blending wants them, and gradients from what blending found of each."""

import math

import numba
import numpy as np

from extrap_train.gaussians.projection_numba import LEAST_ALPHA
from extrap_train.geometry.compiled import compiled

CHANNELS = 4
"""Features are blended so many at a time."""
MOMENTS = 6 + CHANNELS
"""What a slot holds: Σg, Σg·dy, Σg·dy², Σg·e, Σg·e·dy, Σg·e², with g the gradient to log alpha, dy
the distance from the mean along y and e that from the centre line along x; then one sum a feature.
"""
COLUMNS = 8 + CHANNELS
U, V, PRECISION, SLOPE, PRECISION_V, LOG_OPACITY, REACH, FEATURES = 0, 1, 2, 3, 4, 5, 6, 8
"""Columns of a packed ellipse; precisions and logarithms are to base 2."""

LEAST_LOG = np.float32(math.log2(LEAST_ALPHA))
"""No alpha below is blended."""
_HALF_PER_LN2 = np.float32(0.5 / math.log(2))
_ZERO, _HALF = np.float32(0), np.float32(0.5)


@compiled(parallel=True)
def pack(
    means: np.ndarray,
    shapes: np.ndarray,
    opacities: np.ndarray,
    features: np.ndarray,
    radii: np.ndarray,
    packed: np.ndarray,
) -> None:
    """What blending needs of an ellipse, side by side (n COLUMNS), padded with zero features."""
    for i in numba.prange(len(means)):
        packed[i] = 0
        packed[i, REACH] = packed[i, REACH + 1] = -1
        if radii[i, 0] > 0:
            across, down = shapes[i, 0] * _HALF_PER_LN2, shapes[i, 2] * _HALF_PER_LN2
            log = math.log2(opacities[i])
            packed[i, U], packed[i, V], packed[i, LOG_OPACITY] = means[i, 0], means[i, 1], log
            packed[i, PRECISION], packed[i, SLOPE] = across, shapes[i, 1]
            packed[i, PRECISION_V] = down
            span = max(log - LEAST_LOG, _ZERO)
            slope = shapes[i, 1]
            packed[i, REACH] = math.sqrt(span * (1 / across + slope * slope / down))
            packed[i, REACH + 1] = math.sqrt(span / down)
            for c in range(features.shape[1]):
                packed[i, FEATURES + c] = features[i, c]


@compiled(parallel=True)
def unpack(
    slot_starts: np.ndarray,
    moments: np.ndarray,
    shapes: np.ndarray,
    opacities: np.ndarray,
    means_grad: np.ndarray,
    shapes_grad: np.ndarray,
    opacities_grad: np.ndarray,
    features_grad: np.ndarray,
) -> None:
    """Add each ellipse's slots, in order, and make gradients of the moments."""
    for i in numba.prange(len(shapes)):
        means_grad[i], shapes_grad[i], opacities_grad[i], features_grad[i] = 0, 0, 0, 0
        for slot in range(slot_starts[i], slot_starts[i + 1]):
            m = moments[slot]
            pull = shapes[i, 0] * m[3]
            means_grad[i, 0] += pull
            means_grad[i, 1] += shapes[i, 2] * m[1] - shapes[i, 1] * pull
            shapes_grad[i, 0] -= _HALF * m[5]
            shapes_grad[i, 1] += shapes[i, 0] * m[4]
            shapes_grad[i, 2] -= _HALF * m[2]
            opacities_grad[i] += m[0] / opacities[i]
            for c in range(features_grad.shape[1]):
                features_grad[i, c] += m[6 + c]
