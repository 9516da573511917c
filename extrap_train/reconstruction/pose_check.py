"""Poses in another axis convention, found by what the photographs' matches say of them."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float

from extrap_train.errors import InputError
from extrap_train.geometry.epipolar import epipolar_distance, fundamental_matrix
from extrap_train.matching.sift import descriptor_distance, detect_sift, match_mutual
from extrap_train.views import Camera, View

Pixels = Float[np.ndarray, "_ 2"]
"""Pixels, one row per match."""
SIDE = 640
"""Photographs are matched at this many pixels a side, at most."""
LEAST_MATCHES = 30
FAR_PIXELS = 4.0
"""Median epipolar distance from which poses are suspect."""
CLEARLY_BETTER = 0.4
RATIO = 0.75
"""Largest ratio of the nearest and second nearest distance in Lowe's test."""

_FLIPS = {
    "OpenGL axes (+Y up, -Z forward)": (1.0, -1.0, -1.0),
    "PyTorch3D axes (+X left, +Y up)": (-1.0, -1.0, 1.0),
}


def check_poses(views: Sequence[View]) -> None:
    """Raise InputError where matches contradict the poses and another convention explains them.

    Too few matches say nothing, and poses that no convention mends are left to the depth source.
    """
    small = [small_view(view) for view in views]
    described = [(view.camera, detect_sift(view.image)) for view in small]
    matched = []
    for (one, features), (other, others) in pairwise(described):
        pairs = match_mutual(descriptor_distance(features, others), RATIO)
        matched.append((one, other, features.pixels[pairs[:, 0]], others.pixels[pairs[:, 1]]))
    check_matches(matched)


def check_matches(matched: Iterable[tuple[Camera, Camera, Pixels, Pixels]]) -> None:
    """`check_poses` of pairs of views whose pixels are matched."""
    given: list[float] = []
    others: dict[str, list[float]] = {}
    for one, other, first, second in matched:
        if len(first) < LEAST_MATCHES:
            continue
        given.append(_distance(first, second, one, other))
        others_of = _read_otherwise(other)
        for name, camera in _read_otherwise(one).items():
            others.setdefault(name, []).append(_distance(first, second, camera, others_of[name]))
    if not given or np.median(given) < FAR_PIXELS:
        return
    best = min(others, key=lambda name: float(np.median(others[name])))
    if np.median(others[best]) < CLEARLY_BETTER * np.median(given):
        raise InputError(
            f"the poses contradict the photographs: matches lie {np.median(given):.1f} px from "
            f"where they should, but {np.median(others[best]):.1f} px if the poses are read as "
            f"{best}; convert them first"
        )


def small_view(view: View, side: int = SIDE) -> View:
    """The view with at most this many pixels a side."""
    scale = side / max(view.camera.height, view.camera.width)
    if scale >= 1:
        return view
    return view.resized(round(view.camera.height * scale), round(view.camera.width * scale))


def _read_otherwise(camera: Camera) -> dict[str, Camera]:
    """The camera, had its matrix been meant otherwise."""
    flipped = {
        name: torch.diag(torch.tensor([*signs, 1.0])) @ camera.world_to_cam
        for name, signs in _FLIPS.items()
    }
    matrices = flipped | {"camera-to-world matrices": camera.cam_to_world}
    return {name: replace(camera, world_to_cam=found) for name, found in matrices.items()}


def _distance(first: Pixels, second: Pixels, one: Camera, other: Camera) -> float:
    """Median distance of the second points from the first ones' epipolar lines, in pixels."""
    return float(np.median(epipolar_distance(first, second, fundamental_matrix(one, other))))
