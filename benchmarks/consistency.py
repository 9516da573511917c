"""Whether a method's views agree with each other at the given poses, whatever the truth is."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.data.images import to_eight_bits
from extrap_train.geometry.viewpoints import pairwise_angles, scene_center
from extrap_train.geometry.warp import warp_references
from extrap_train.metrics import psnr
from extrap_train.views import Camera

TSED_PIXELS = 2.0
"""Largest median symmetric epipolar distance of a consistent pair, in 256² frames."""
TSED_MATCHES = 10
TSED_FRAME = 256
_EDGE_THRESHOLD = 30.0
"""COLMAP's, as published; OpenCV divides nothing by it."""
_RATIO = 0.8
LEAST_SHARED = 0.1
"""A pair of views says something where at least this share of a view is seen by both."""


def neighbour_pairs(cameras: Camera) -> list[tuple[int, int]]:
    """Every view with the view nearest to it in angle about the scene's centre, each pair once."""
    if len(cameras.world_to_cam) < 2:
        return []
    angles = pairwise_angles(cameras, scene_center(cameras))
    np.fill_diagonal(angles, np.inf)
    nearest = [(i, int(row.argmin())) for i, row in enumerate(angles)]
    return sorted({(min(pair), max(pair)) for pair in nearest})


@dataclass(frozen=True)
class Matches:
    """Pixels of two frames that look alike."""

    first: Float[np.ndarray, "m 2"]
    second: Float[np.ndarray, "m 2"]


def tsed(images: Float[Tensor, "n 3 h w"], cameras: Camera) -> float:
    """Thresholded symmetric epipolar distance (Yu et al., 2023): the share of neighbouring pairs
    whose SIFT matches lie on each other's epipolar lines; NaN for fewer than two views.

    A pair with fewer than 10 matches is inconsistent. Frames are resampled to 256 × 256 first, so
    that the 2 px mean what they meant there.
    """
    pairs = neighbour_pairs(cameras)
    frames = [_grey(image) for image in images]
    enlarged = cameras.resized(TSED_FRAME, TSED_FRAME)
    consistent = [
        _is_consistent(_match(frames[i], frames[j]), enlarged[i], enlarged[j]) for i, j in pairs
    ]
    return float(np.mean(consistent)) if consistent else math.nan


def _grey(image: Float[Tensor, "3 h w"]) -> np.ndarray:
    pixels = cv2.cvtColor(to_eight_bits(image.permute(1, 2, 0)), cv2.COLOR_RGB2GRAY)
    return cv2.resize(pixels, (TSED_FRAME, TSED_FRAME), interpolation=cv2.INTER_CUBIC)


def _match(first: np.ndarray, second: np.ndarray) -> Matches:
    """SIFT with the ratio test, both ways."""
    sift = cv2.SIFT.create(edgeThreshold=_EDGE_THRESHOLD)
    (points_a, found_a), (points_b, found_b) = (
        sift.detectAndCompute(f, None) for f in (first, second)
    )
    empty = np.zeros((0, 2))
    if found_a is None or found_b is None or min(len(found_a), len(found_b)) < 2:
        return Matches(empty, empty)
    forth, back = _best(found_a, found_b), _best(found_b, found_a)
    mutual = [(a, b) for a, b in forth.items() if back.get(b) == a]
    if not mutual:
        return Matches(empty, empty)
    # OpenCV's pixel centres are whole numbers, ours are half ones.
    return Matches(
        np.array([points_a[a].pt for a, _ in mutual]) + 0.5,
        np.array([points_b[b].pt for _, b in mutual]) + 0.5,
    )


def _best(query: np.ndarray, train: np.ndarray) -> dict[int, int]:
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(query, train, k=2)
    return {
        near.queryIdx: near.trainIdx for near, far in pairs if near.distance < _RATIO * far.distance
    }


def _is_consistent(matches: Matches, first: Camera, second: Camera) -> bool:
    if len(matches.first) < TSED_MATCHES:
        return False
    distance = epipolar_distance(matches.first, matches.second, first, second)
    return float(np.median(distance)) < TSED_PIXELS


def epipolar_distance(
    first: Float[np.ndarray, "m 2"], second: Float[np.ndarray, "m 2"], one: Camera, two: Camera
) -> Float[np.ndarray, " m"]:
    """Mean of each match's two distances, in pixels, to the other's epipolar line (the "symmetric
    epipolar distance"), from the given poses.
    """
    relative = (two.world_to_cam @ one.cam_to_world).double().numpy(force=True)
    rotation, t = relative[:3, :3], relative[:3, 3]
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    inverse_one, inverse_two = (
        np.linalg.inv(camera.intrinsics.double().numpy(force=True)) for camera in (one, two)
    )
    fundamental = inverse_two.T @ cross @ rotation @ inverse_one
    a, b = (np.concatenate([points, np.ones((len(points), 1))], 1) for points in (first, second))
    line_two, line_one = a @ fundamental.T, b @ fundamental
    residual = np.abs((b * line_two).sum(1))
    return 0.5 * (
        residual / np.linalg.norm(line_two[:, :2], axis=1)
        + residual / np.linalg.norm(line_one[:, :2], axis=1)
    )


def warp_psnr(
    images: Float[Tensor, "n 3 h w"], depths: Float[Tensor, "n h w"], cameras: Camera
) -> float:
    """Each view against its neighbour warped into it by the true depth, both ways, in dB; the mean
    over the pairs that share enough; NaN where none does.

    On the truth's own images this is the floor that no method can be asked to beat.
    """
    values = [
        value
        for i, j in neighbour_pairs(cameras)
        for a, b in ((i, j), (j, i))
        if (value := _warp_psnr(images, depths, cameras, a, b)) is not None
    ]
    return float(np.mean(values)) if values else math.nan


def _warp_psnr(
    images: Tensor, depths: Tensor, cameras: Camera, source: int, target: int
) -> float | None:
    chosen: Sequence[int] = [source]
    warp = warp_references(
        images[chosen][None],
        depths[chosen][None],
        cameras[torch.tensor([chosen])],
        torch.ones(1, 1, dtype=torch.bool),
        cameras[torch.tensor([target])],
    )
    true = depths[target]
    same = (warp.depth[0] - true).abs() < 0.02 * true
    mask = (warp.mask[0] * same).to(images.dtype)
    if float(mask.mean()) < LEAST_SHARED:
        return None
    return float(psnr(warp.image, images[target][None], mask[None]))
