"""SIFT features (Lowe, 2004) and mutual matches between them."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True)
class Features:
    """SIFT features of one picture."""

    pixels: Float[np.ndarray, "n 2"]
    """(u, v) in the picture's own pixels, centres at +0.5."""
    descriptors: Float[np.ndarray, "n 128"]


def detect_sift(
    image: Float[Tensor, "3 h w"],
    size: tuple[int, int] | None = None,
    *,
    contrast_threshold: float = 0.04,
    edge_threshold: float = 10.0,
) -> Features:
    """Features of a picture, resampled to `size` (height, width) first; none without texture."""
    pixels = (image.detach().cpu().clamp(0, 1) * 255).round().byte().permute(1, 2, 0)
    grey = cv2.cvtColor(np.ascontiguousarray(pixels.numpy()), cv2.COLOR_RGB2GRAY)
    height, width = size or grey.shape
    scale = np.array([width / grey.shape[1], height / grey.shape[0]])
    if (height, width) != grey.shape:
        grey = cv2.resize(grey, (width, height), interpolation=cv2.INTER_CUBIC)
    finder = cv2.SIFT.create(contrastThreshold=contrast_threshold, edgeThreshold=edge_threshold)
    keypoints, descriptors = finder.detectAndCompute(grey, None)
    if descriptors is None:
        return Features(np.zeros((0, 2)), np.zeros((0, 128), np.float32))
    # OpenCV's pixel centres are whole numbers.
    return Features((np.array([point.pt for point in keypoints]) + 0.5) / scale, descriptors)


def root_sift(features: Features) -> Features:
    """The features with RootSIFT descriptors (Arandjelović and Zisserman, 2012) of unit length."""
    total = np.maximum(features.descriptors.sum(1, keepdims=True), 1e-12)
    return replace(features, descriptors=np.sqrt(features.descriptors / total))


def descriptor_distance(first: Features, second: Features) -> Float[np.ndarray, "n m"]:
    """Euclidean distance between every two descriptors."""
    a, b = first.descriptors, second.descriptors
    squared = (a * a).sum(1)[:, None] + (b * b).sum(1) - 2 * a @ b.T
    return np.sqrt(np.maximum(squared, 0))


def match_mutual(distance: Float[np.ndarray, "n m"], ratio: float) -> Int[np.ndarray, "k 2"]:
    """Index pairs that are each other's nearest, by Lowe's ratio test in both directions.

    The nearest must be at most `ratio` times as far as the second nearest. An infinite distance
    excludes a pair.
    """
    if not distance.size:
        return np.zeros((0, 2), np.int64)
    rows = np.arange(len(distance))
    there, back = distance.argmin(1), distance.argmin(0)
    best = distance[rows, there]
    kept = np.isfinite(best) & (back[there] == rows)
    for other in (_second_best(distance, 1), _second_best(distance, 0)[there]):
        kept &= best <= ratio * other
    return np.stack([rows[kept], there[kept]], 1)


def _second_best(distance: Float[np.ndarray, "n m"], axis: int) -> Float[np.ndarray, " k"]:
    """Infinite where there is one alone."""
    if distance.shape[axis] < 2:
        return np.full(distance.shape[1 - axis], np.inf)
    return np.take(np.partition(distance, 1, axis), 1, axis)
