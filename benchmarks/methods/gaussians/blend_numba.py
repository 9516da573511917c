"""Blending sorted ellipses tile by tile, and its derivative: compiled loops, parallel over tiles.

The backward pass walks each tile's Gaussians back to front. What it finds goes to a slot of its own
for each meeting of a Gaussian with a tile, and the slots of a Gaussian are then added in a fixed
order: nothing is added by two threads, so the same bits come out on any number of them.
"""

import math

import numba
import numpy as np

from benchmarks.methods.gaussians.tiles_numba import TILE
from extrap_train.geometry.compiled import compiled

MOST_ALPHA = 0.999
LEAST_TRANSMITTANCE = 1e-4
"""A pixel is full when the next Gaussian would leave less light than this."""
_LEAST_ALPHA = 1 / 255
MEAN, SHAPE, OPACITY, FEATURES = 0, 2, 5, 6
"""Where the gradients lie in a slot."""


@compiled()
def _alpha(
    mean: np.ndarray, shape: np.ndarray, opacity: float, x: int, y: int
) -> tuple[float, float, float]:
    """Unclamped alpha at a pixel's centre, and the centre's offset: along x from the centre line,
    and along y."""
    down = y + 0.5 - mean[1]
    across = x + 0.5 - mean[0] - shape[1] * down
    exponent = 0.5 * (shape[0] * across * across + shape[2] * down * down)
    return opacity * math.exp(-exponent), across, down


@compiled(parallel=True)
def blend(
    means: np.ndarray,
    shapes: np.ndarray,
    opacities: np.ndarray,
    features: np.ndarray,
    background: np.ndarray,
    starts: np.ndarray,
    gaussians: np.ndarray,
    image: np.ndarray,
    transmittance: np.ndarray,
    ends: np.ndarray,
) -> None:
    """Blend front to back: `image` (h w d), what light is left, and one past the last meeting."""
    height, width, channels = image.shape
    columns = -(-width // TILE)
    for tile in numba.prange(len(starts) - 1):
        top, left = tile // columns * TILE, tile % columns * TILE
        for y in range(top, min(top + TILE, height)):
            for x in range(left, min(left + TILE, width)):
                image[y, x] = 0
                light = means.dtype.type(1)
                end = starts[tile]
                for m in range(starts[tile], starts[tile + 1]):
                    i = gaussians[m]
                    alpha, _, _ = _alpha(means[i], shapes[i], opacities[i], x, y)
                    alpha = min(alpha, MOST_ALPHA)
                    if alpha < _LEAST_ALPHA:
                        continue
                    if light * (1 - alpha) <= LEAST_TRANSMITTANCE:
                        break
                    for c in range(channels):
                        image[y, x, c] += features[i, c] * (alpha * light)
                    light *= 1 - alpha
                    end = m + 1
                for c in range(channels):
                    image[y, x, c] += light * background[c]
                transmittance[y, x], ends[y, x] = light, end


@compiled(parallel=True)
def blend_backward(
    means: np.ndarray,
    shapes: np.ndarray,
    opacities: np.ndarray,
    features: np.ndarray,
    background: np.ndarray,
    starts: np.ndarray,
    gaussians: np.ndarray,
    slots: np.ndarray,
    transmittance: np.ndarray,
    ends: np.ndarray,
    image_grad: np.ndarray,
    transmittance_grad: np.ndarray,
    slot_grads: np.ndarray,
) -> None:
    """Write the gradient of each meeting to its slot (zeros before)."""
    height, width, channels = image_grad.shape
    columns = -(-width // TILE)
    for tile in numba.prange(len(starts) - 1):
        top, left = tile // columns * TILE, tile % columns * TILE
        for y in range(top, min(top + TILE, height)):
            for x in range(left, min(left + TILE, width)):
                light = transmittance[y, x]
                behind = transmittance_grad[y, x] * light
                for c in range(channels):
                    behind += background[c] * image_grad[y, x, c] * light
                for m in range(ends[y, x] - 1, starts[tile] - 1, -1):
                    i = gaussians[m]
                    free_alpha, across, down = _alpha(means[i], shapes[i], opacities[i], x, y)
                    alpha = min(free_alpha, MOST_ALPHA)
                    if alpha < _LEAST_ALPHA:
                        continue
                    light /= 1 - alpha
                    out = slot_grads[slots[m]]
                    value = means.dtype.type(0)
                    for c in range(channels):
                        value += features[i, c] * image_grad[y, x, c]
                        out[FEATURES + c] += alpha * light * image_grad[y, x, c]
                    alpha_grad = light * value - behind / (1 - alpha)
                    behind += alpha * light * value
                    if free_alpha <= MOST_ALPHA:
                        _add_geometry(shapes[i], across, down, alpha * alpha_grad, out)
                        out[OPACITY] += alpha / opacities[i] * alpha_grad


@compiled()
def _add_geometry(
    shape: np.ndarray, across: float, down: float, log_grad: float, out: np.ndarray
) -> None:
    """Chain the gradient to log(alpha) on to mean and shape."""
    pull = shape[0] * across * log_grad
    out[MEAN] += pull
    out[MEAN + 1] += shape[2] * down * log_grad - shape[1] * pull
    out[SHAPE] -= 0.5 * across * across * log_grad
    out[SHAPE + 1] += pull * down
    out[SHAPE + 2] -= 0.5 * down * down * log_grad


@compiled(parallel=True)
def add_slots(slot_starts: np.ndarray, slot_grads: np.ndarray, grads: np.ndarray) -> None:
    """Add each Gaussian's slots, in order."""
    for i in numba.prange(len(grads)):
        grads[i] = 0
        for slot in range(slot_starts[i], slot_starts[i + 1]):
            for c in range(grads.shape[1]):
                grads[i, c] += slot_grads[slot, c]
