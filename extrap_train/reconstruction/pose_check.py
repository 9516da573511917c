"""Poses in another axis convention, found by what the photographs' matches say of them."""

from collections.abc import Sequence
from itertools import pairwise

import cv2
import numpy as np
import torch
from jaxtyping import Float

from extrap_train.errors import InputError
from extrap_train.views import Camera, View

SIDE = 640
"""Photographs are matched at this many pixels a side, at most."""
LEAST_MATCHES = 30
FAR_PIXELS = 4.0
"""Median epipolar distance from which poses are suspect."""
CLEARLY_BETTER = 0.4
RATIO = 0.75
"""Of Lowe's test."""

_FLIPS = {
    "OpenGL axes (+Y up, -Z forward)": (1.0, -1.0, -1.0),
    "PyTorch3D axes (+X left, +Y up)": (-1.0, -1.0, 1.0),
}


def check_poses(views: Sequence[View]) -> None:
    """Raise InputError where matches contradict the poses and another convention explains them.

    Too few matches say nothing, and poses that no convention mends are left to the depth source.
    """
    given: list[float] = []
    others: dict[str, list[float]] = {}
    small = [_small(view) for view in views]
    for one, other in pairwise(small):
        matches = _matches(one, other)
        if len(matches) < LEAST_MATCHES:
            continue
        given.append(_distance(matches, one.camera, other.camera))
        for name, cameras in _alternatives(one.camera, other.camera).items():
            others.setdefault(name, []).append(_distance(matches, *cameras))
    if not given or np.median(given) < FAR_PIXELS:
        return
    best = min(others, key=lambda name: float(np.median(others[name])))
    if np.median(others[best]) < CLEARLY_BETTER * np.median(given):
        raise InputError(
            f"the poses contradict the photographs: matches lie {np.median(given):.1f} px from "
            f"where they should, but {np.median(others[best]):.1f} px if the poses are read as "
            f"{best}; convert them first"
        )


def _small(view: View) -> View:
    scale = SIDE / max(view.camera.height, view.camera.width)
    if scale >= 1:
        return view
    return view.resized(round(view.camera.height * scale), round(view.camera.width * scale))


def _alternatives(one: Camera, other: Camera) -> dict[str, tuple[Camera, Camera]]:
    """Both cameras, had their matrices been meant otherwise."""
    found = {name: (_flipped(one, signs), _flipped(other, signs)) for name, signs in _FLIPS.items()}
    found["camera-to-world matrices"] = (_inverted(one), _inverted(other))
    return found


def _flipped(camera: Camera, signs: tuple[float, float, float]) -> Camera:
    flip = torch.diag(torch.tensor([*signs, 1.0]))
    return Camera(flip @ camera.world_to_cam, camera.intrinsics, camera.height, camera.width)


def _inverted(camera: Camera) -> Camera:
    return Camera(camera.cam_to_world, camera.intrinsics, camera.height, camera.width)


def _matches(one: View, other: View) -> Float[np.ndarray, "n 4"]:
    """(u, v) in the first and in the second picture, by SIFT, mutual and distinct."""
    finder = cv2.SIFT.create()
    grey = [
        cv2.cvtColor(
            (view.image * 255).byte().permute(1, 2, 0).contiguous().numpy(), cv2.COLOR_RGB2GRAY
        )
        for view in (one, other)
    ]
    (points, first), (other_points, second) = (finder.detectAndCompute(g, None) for g in grey)
    if first is None or second is None or min(len(first), len(second)) < 2:
        return np.zeros((0, 4))
    pairs = cv2.BFMatcher().knnMatch(first, second, k=2)
    kept = [m for m, n in (p for p in pairs if len(p) == 2) if m.distance < RATIO * n.distance]
    return np.array([[*points[m.queryIdx].pt, *other_points[m.trainIdx].pt] for m in kept]).reshape(
        -1, 4
    )


def _distance(matches: Float[np.ndarray, "n 4"], one: Camera, other: Camera) -> float:
    """Median distance of the second point from the first one's epipolar line, in pixels."""
    relative = (other.world_to_cam @ one.cam_to_world).double().numpy()
    x, y, z = relative[:3, 3] / max(float(np.linalg.norm(relative[:3, 3])), 1e-12)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    k, k_other = (camera.intrinsics.double().numpy() for camera in (one, other))
    fundamental = np.linalg.inv(k_other).T @ cross @ relative[:3, :3] @ np.linalg.inv(k)
    # OpenCV counts pixel centres from 0, we from +0.5.
    first = np.c_[matches[:, :2] + 0.5, np.ones(len(matches))]
    second = np.c_[matches[:, 2:] + 0.5, np.ones(len(matches))]
    lines = first @ fundamental.T
    length = np.linalg.norm(lines[:, :2], axis=1)
    return float(np.median(np.abs((lines * second).sum(1)) / np.maximum(length, 1e-12)))
