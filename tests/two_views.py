"""How far matched features lie from their epipolar lines: no wrong convention hides from it."""

from itertools import pairwise

import cv2
import numpy as np

from extrap_train.views import Camera, View


def epipolar_distances(views: list[View]) -> np.ndarray:
    """Distances in pixels of SIFT features from the lines of their matches in the view before."""
    described = [(view.camera, *features(view)) for view in views]
    return np.concatenate([_distances(*first, *second) for first, second in pairwise(described)])


def _distances(camera, pixels, descriptors, other_camera, other_pixels, other_descriptors):
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(descriptors, other_descriptors, k=2)
    good = [best for best, rival in pairs if best.distance < 0.7 * rival.distance]
    points = pixels[[match.queryIdx for match in good]]
    others = other_pixels[[match.trainIdx for match in good]]
    return line_distances(points, others, camera, other_camera)


def features(view: View) -> tuple[np.ndarray, np.ndarray]:
    picture = (view.image.permute(1, 2, 0).numpy() * 255).astype(np.uint8)
    mask = None if view.mask is None else (view.mask.numpy() > 0.5).astype(np.uint8)
    points, descriptors = cv2.SIFT_create(3000).detectAndCompute(picture, mask)
    # OpenCV's pixel centres lie at whole numbers.
    return np.array([point.pt for point in points]) + 0.5, descriptors


def fundamental(first: Camera, second: Camera) -> np.ndarray:
    """F with x₂ᵀ F x₁ = 0."""
    relative = (second.world_to_cam.double() @ first.world_to_cam.double().inverse()).numpy()
    x, y, z = relative[:3, 3]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    k_first, k_second = (camera.intrinsics.double().numpy() for camera in (first, second))
    return np.linalg.inv(k_second).T @ cross @ relative[:3, :3] @ np.linalg.inv(k_first)


def homogeneous(pixels: np.ndarray) -> np.ndarray:
    return np.concatenate([pixels, np.ones((len(pixels), 1))], 1)


def line_distances(
    points: np.ndarray, others: np.ndarray, first: Camera, second: Camera
) -> np.ndarray:
    """Distances in pixels of `others`, in the second view, from the lines of `points`."""
    lines = homogeneous(points) @ fundamental(first, second).T
    return np.abs((lines * homogeneous(others)).sum(1)) / np.linalg.norm(lines[:, :2], axis=1)
