"""Arithmetic on many 3-vectors, which unlike BLAS gives the same bits for any number of threads;
and gradient noise in space, the grain of every procedural texture.
"""

import numpy as np
from jaxtyping import Float

from extrap_train.geometry.compiled import compiled

Real = int | float


@compiled()
def _rotate(vectors, matrix):
    out = np.empty_like(vectors)
    for n in range(len(vectors)):
        x, y, z = vectors[n, 0], vectors[n, 1], vectors[n, 2]
        for i in range(3):
            out[n, i] = matrix[i, 0] * x + matrix[i, 1] * y + matrix[i, 2] * z
    return out


@compiled()
def _dot(a, b):
    out = np.empty(len(a), a.dtype)
    for n in range(len(a)):
        out[n] = a[n, 0] * b[n, 0] + a[n, 1] * b[n, 1] + a[n, 2] * b[n, 2]
    return out


@compiled()
def _normalize(vectors):
    out = np.empty_like(vectors)
    for n in range(len(vectors)):
        x, y, z = vectors[n, 0], vectors[n, 1], vectors[n, 2]
        length = np.sqrt(x * x + y * y + z * z) + 1e-12
        out[n, 0], out[n, 1], out[n, 2] = x / length, y / length, z / length
    return out


def rotate(
    vectors: Float[np.ndarray, "n 3"], matrix: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "n 3"]:
    """`matrix` applied to each vector, in the vectors' precision."""
    return _rotate(np.ascontiguousarray(vectors), np.ascontiguousarray(matrix, vectors.dtype))


def dot(a: Float[np.ndarray, "n 3"], b: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, " n"]:
    """Dot products of corresponding vectors."""
    return _dot(np.ascontiguousarray(a), np.broadcast_to(b, a.shape).astype(a.dtype, copy=False))


def normalize(vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Each vector at unit length; a zero vector stays zero."""
    return _normalize(np.ascontiguousarray(vectors))


_KEPT, _GONE = 0.25, 0.9
"""Footprint in wavelengths between which an octave fades, so that nothing aliases."""


@compiled()
def _hash(x, y, z, seed):
    """32 well-mixed bits of a lattice point."""
    h = (x * 0x8DA6B343 + y * 0xD8163841 + z * 0xCB1AB31F + seed * 0x9E3779B1) & 0xFFFFFFFF
    h = ((h ^ (h >> 15)) * 0x2C1B3C6D) & 0xFFFFFFFF
    h = ((h ^ (h >> 12)) * 0x297A2D39) & 0xFFFFFFFF
    return h ^ (h >> 15)


@compiled()
def _slope(h, x, y, z):
    """Dot product with one of Perlin's twelve edge gradients."""
    h = h & 15
    a = x if h < 8 else y
    b = y if h < 4 else (x if h in (12, 14) else z)
    return (a if h & 1 == 0 else -a) + (b if h & 2 == 0 else -b)


@compiled()
def _perlin(x, y, z, seed):
    """Perlin's improved noise (2002), about −0.9 … 0.9."""
    i, j, k = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
    x, y, z = x - i, y - j, z - k
    a = x * x * x * (x * (x * 6 - 15) + 10)
    b = y * y * y * (y * (y * 6 - 15) + 10)
    c = z * z * z * (z * (z * 6 - 15) + 10)
    total = 0.0
    for corner in range(8):
        p, q, r = corner & 1, (corner >> 1) & 1, corner >> 2
        weight = (a if p else 1 - a) * (b if q else 1 - b) * (c if r else 1 - c)
        total += weight * _slope(_hash(i + p, j + q, k + r, seed), x - p, y - q, z - r)
    return total


@compiled()
def _fractal(points, footprint, frequency, octaves, seed):
    out = np.empty(len(points), np.float32)
    for n in range(len(points)):
        total, amplitude, f = 0.0, 0.5, frequency
        for octave in range(octaves):
            fade = (_GONE - footprint[n] * f) / (_GONE - _KEPT)
            if fade <= 0:
                break
            value = _perlin(points[n, 0] * f, points[n, 1] * f, points[n, 2] * f, seed + octave)
            total += value * amplitude * min(fade, 1.0)
            amplitude, f = amplitude * 0.5, f * 2.03
        out[n] = total * 2
    return out


def fractal_noise(
    points: Float[np.ndarray, "n 3"],
    footprint: Float[np.ndarray, " n"],
    frequency: Real,
    octaves: int,
    seed: int,
) -> Float[np.ndarray, " n"]:
    """Summed octaves of Perlin noise, mean 0, mostly within ±1, none finer than a pixel.

    `frequency` counts cells per unit of `points`; `footprint` is a pixel's width on the surface.
    """
    return _fractal(points, footprint, frequency, octaves, seed)
