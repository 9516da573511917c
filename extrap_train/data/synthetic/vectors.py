"""Arithmetic on many 3-vectors; unlike BLAS it gives the same bits for any number of threads."""

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
