"""Estimated cameras against true ones, up to the similarity that no photograph tells."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from skimage.transform import SimilarityTransform

from extrap_train.geometry.viewpoints import scene_center
from extrap_train.views import Camera, stack_poses


@dataclass(frozen=True)
class PoseErrors:
    rotation_deg: np.ndarray
    translation: np.ndarray
    """As shares of the median distance between the true cameras and the scene's centre."""


def pose_errors(estimated: Sequence[Camera], true: Sequence[Camera]) -> PoseErrors:
    """After the similarity that brings the estimated positions nearest to the true ones."""
    poses, truth = stack_poses(estimated), stack_poses(true)
    centers, targets = (cameras.center.double().numpy() for cameras in (poses, truth))
    fit = SimilarityTransform(dimensionality=3)
    assert fit.estimate(centers, targets)
    turn = fit.params[:3, :3] / fit.scale
    rotations, wanted = (c.world_to_cam[:, :3, :3].double().numpy() for c in (poses, truth))
    between = rotations @ turn.T @ wanted.transpose(0, 2, 1)
    cosine = (np.trace(between, axis1=1, axis2=2) - 1) / 2
    radius = np.median(np.linalg.norm(targets - scene_center(truth), axis=1))
    moved = centers @ fit.params[:3, :3].T + fit.params[:3, 3]
    return PoseErrors(
        np.degrees(np.arccos(np.clip(cosine, -1, 1))),
        np.linalg.norm(moved - targets, axis=1) / radius,
    )
