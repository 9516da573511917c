"""Whether a method's views agree with each other at the given poses, whatever the truth is."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.geometry.epipolar import epipolar_distance, fundamental_matrix
from extrap_train.geometry.viewpoints import pairwise_angles, scene_center
from extrap_train.geometry.warp import warp_references
from extrap_train.matching.sift import Features, descriptor_distance, detect_sift, match_mutual
from extrap_train.metrics import psnr
from extrap_train.views import Camera

TSED_PIXELS = 2.0
"""Largest median symmetric epipolar distance of a consistent pair, in 256² frames."""
TSED_MATCHES = 10
TSED_FRAME = 256
_EDGE_THRESHOLD = 30.0
"""COLMAP's, as published; OpenCV divides nothing by it."""
_RATIO = 0.8
MIN_SHARED = 0.1
"""A pair of views says something where at least this share of a view is seen by both."""


def neighbour_pairs(cameras: Camera) -> list[tuple[int, int]]:
    """Every view with the view nearest to it in angle about the scene's centre, each pair once."""
    if len(cameras.world_to_cam) < 2:
        return []
    angles = pairwise_angles(cameras, scene_center(cameras))
    np.fill_diagonal(angles, np.inf)
    nearest = [(i, int(row.argmin())) for i, row in enumerate(angles)]
    return sorted({(min(pair), max(pair)) for pair in nearest})


def tsed(images: Float[Tensor, "n 3 h w"], cameras: Camera) -> float:
    """Thresholded symmetric epipolar distance (Yu et al., 2023): the share of neighbouring pairs
    whose SIFT matches lie on each other's epipolar lines; NaN for fewer than two views.

    A pair with fewer than 10 matches is inconsistent. Frames are resampled to 256 × 256 first, so
    that the 2 px mean what they meant there.
    """
    features = [
        detect_sift(image, (TSED_FRAME, TSED_FRAME), edge_threshold=_EDGE_THRESHOLD)
        for image in images
    ]
    consistent = [
        _is_consistent(features[i], features[j], cameras[i], cameras[j])
        for i, j in neighbour_pairs(cameras)
    ]
    return float(np.mean(consistent)) if consistent else math.nan


def _is_consistent(first: Features, second: Features, camera: Camera, other: Camera) -> bool:
    pairs = match_mutual(descriptor_distance(first, second), _RATIO)
    if len(pairs) < TSED_MATCHES:
        return False
    scale = np.array([TSED_FRAME / camera.width, TSED_FRAME / camera.height])
    distance = symmetric_epipolar_distance(
        first.pixels[pairs[:, 0]] * scale,
        second.pixels[pairs[:, 1]] * scale,
        fundamental_matrix(
            camera.resized(TSED_FRAME, TSED_FRAME), other.resized(TSED_FRAME, TSED_FRAME)
        ),
    )
    return float(np.median(distance)) < TSED_PIXELS


def symmetric_epipolar_distance(
    first: Float[np.ndarray, "m 2"],
    second: Float[np.ndarray, "m 2"],
    fundamental: Float[np.ndarray, "3 3"],
) -> Float[np.ndarray, " m"]:
    """Mean of each match's two distances, in pixels, to the other's epipolar line."""
    return 0.5 * (
        epipolar_distance(first, second, fundamental)
        + epipolar_distance(second, first, fundamental.T)
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
    if float(mask.mean()) < MIN_SHARED:
        return None
    return float(psnr(warp.image, images[target][None], mask[None]))
