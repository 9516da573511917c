"""Correspondences between photographs with known poses: SIFT, told where a match may lie."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int

from extrap_train.views import Camera, View

WORKING_SIDE = 512
"""Smaller photographs are enlarged to this longer side first: SIFT needs room for its octaves."""
RATIO = 0.8
"""Lowe's: the best match must be this much nearer than the second best."""
EPIPOLAR_SHARE = 0.006
"""Farthest a match may lie from its epipolar line, as a share of the longer side."""


@dataclass(frozen=True)
class Features:
    """SIFT features of one photograph."""

    pixels: Float[np.ndarray, "n 2"]
    """(u, v) in the photograph's own pixels."""
    descriptors: Float[np.ndarray, "n 128"]
    """RootSIFT (Arandjelović and Zisserman, 2012): unit length."""


def detect(view: View) -> Features:
    """The photograph's features; none where it has no texture."""
    image = (view.image.clamp(0, 1) * 255).round().byte().permute(1, 2, 0).numpy()
    grey = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY)
    scale = max(1.0, WORKING_SIDE / max(grey.shape))
    if scale > 1:
        grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
    sift = cv2.SIFT_create(contrastThreshold=0.02)  # type: ignore[attr-defined]
    keypoints, descriptors = sift.detectAndCompute(grey, None)
    if descriptors is None:
        return Features(np.zeros((0, 2)), np.zeros((0, 128), np.float32))
    # OpenCV's pixel centres are whole numbers.
    pixels = (np.array([point.pt for point in keypoints]) + 0.5) / scale
    share = descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-12)
    return Features(pixels, np.sqrt(share))


def match(
    first: Features, second: Features, cameras: tuple[Camera, Camera]
) -> Int[np.ndarray, "m 2"]:
    """Index pairs that are each other's nearest among those on the epipolar line, and distinct."""
    if not len(first.pixels) or not len(second.pixels):
        return np.zeros((0, 2), np.int64)
    distance = np.sqrt(np.maximum(2 - 2 * first.descriptors @ second.descriptors.T, 0))
    limit = EPIPOLAR_SHARE * max(cameras[1].height, cameras[1].width)
    distance[epipolar_distance(first.pixels, second.pixels, cameras) > limit] = np.inf
    rows = np.arange(len(first.pixels))
    there, back = distance.argmin(1), distance.argmin(0)
    best = distance[rows, there]
    kept = np.isfinite(best) & (back[there] == rows)
    for other in (_second_best(distance, 1), _second_best(distance, 0)[there]):
        kept &= best <= RATIO * other
    return np.stack([rows[kept], there[kept]], 1)


def _second_best(distance: Float[np.ndarray, "n m"], axis: int) -> Float[np.ndarray, " k"]:
    """Of the descriptors on the line; infinite where there is one alone."""
    if distance.shape[axis] < 2:
        return np.full(distance.shape[1 - axis], np.inf)
    return np.take(np.partition(distance, 1, axis), 1, axis)


def epipolar_distance(
    first: Float[np.ndarray, "n 2"],
    second: Float[np.ndarray, "m 2"],
    cameras: tuple[Camera, Camera],
) -> Float[np.ndarray, "n m"]:
    """Pixels between each point of the second image and the epipolar line of each of the first."""
    lines = _homogeneous(first) @ fundamental(*cameras).T
    norm = np.maximum(np.linalg.norm(lines[:, :2], axis=1, keepdims=True), 1e-12)
    return np.abs((lines / norm) @ _homogeneous(second).T)


def fundamental(first: Camera, second: Camera) -> Float[np.ndarray, "3 3"]:
    """F with `x_second · F x_first = 0`, from the known cameras."""
    relative = (second.world_to_cam.double() @ first.cam_to_world.double()).numpy()
    x, y, z = relative[:3, 3]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    inverses = [np.linalg.inv(c.intrinsics.double().numpy()) for c in (first, second)]
    return inverses[1].T @ cross @ relative[:3, :3] @ inverses[0]


def _homogeneous(pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    return np.concatenate([pixels, np.ones((len(pixels), 1))], 1)


def projection_matrices(cameras: Sequence[Camera]) -> Float[np.ndarray, "k 3 4"]:
    """`K [R | t]` of every camera, in float64."""
    rows = [c.intrinsics.double() @ c.world_to_cam[:3].double() for c in cameras]
    return torch.stack(rows).numpy()
