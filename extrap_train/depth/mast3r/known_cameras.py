"""A pair's point maps in a world with known cameras: their scale, and each view's depth."""

import math

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.depth import DepthMap
from extrap_train.depth.mast3r.network.point_map_network import PredictedPoints
from extrap_train.geometry.cameras import pixel_grid, transform
from extrap_train.views import Camera

SAMPLES = 4000
"""Pixels that vote for the second camera: the more certain half, thinned out evenly."""
TOLERANCE = 0.01
"""Reprojection error of an inlier, as a share of the picture's longer side."""
MIN_INLIERS = 0.2
"""Share of the votes below which a camera is not found."""
MIN_PARALLAX_RAD = math.radians(1)
"""The baseline, seen from the middle of the points: a shorter one has no reliable scale."""
MAX_CONTRADICTION_RAD = math.radians(20)
"""Between predicted and known rotation, and between the two directions of the baseline."""


def posed_depths(
    first: PredictedPoints, second: PredictedPoints, first_camera: Camera, second_camera: Camera
) -> tuple[DepthMap, DepthMap] | None:
    """Both views' depth in scene units, from a pair's points in the network's own unit.

    The network's second camera comes from the second view's points and its known intrinsics
    (perspective n points, RANSAC). The pair's scale is the known baseline over the predicted one,
    whether the network speaks metres or of no unit at all. None where there is no parallax, or the
    predicted cameras contradict the known ones.
    Confidence is 1 − 1/c of the network's c ≥ 1.
    """
    points = [prediction.points[0].float().cpu() for prediction in (first, second)]
    sureness = [1 - 1 / prediction.confidence[0].float().cpu() for prediction in (first, second)]
    first_to_second = predicted_pose(points[1], sureness[1], second_camera)
    if first_to_second is None:
        return None
    known = (second_camera.world_to_cam @ first_camera.cam_to_world).double().cpu()
    scale = pair_scale(first_to_second, known, typical_depth=float(points[0][..., 2].median()))
    if scale is None:
        return None
    own = transform(first_to_second.float(), points[1].flatten(0, 1)).view_as(points[1])
    return _depth_map(points[0], sureness[0], scale), _depth_map(own, sureness[1], scale)


def predicted_pose(
    points: Float[Tensor, "h w 3"], sureness: Float[Tensor, "h w"], camera: Camera
) -> Float[Tensor, "4 4"] | None:
    """From the points' frame to the frame of the camera with `camera`'s intrinsics that sees each
    of them at its pixel; double precision, None where no camera does."""
    pixels = pixel_grid(camera.height, camera.width).reshape(-1, 2)
    ranked = sureness.flatten().argsort(descending=True, stable=True)
    votes = ranked[: max(len(ranked) // 2, 4)]
    votes = votes[:: max(len(votes) // SAMPLES, 1)]
    objects = points.reshape(-1, 3)[votes].double().numpy()
    seen = pixels[votes].double().numpy()
    intrinsics = camera.intrinsics.double().cpu().numpy()
    try:
        found, rotation, translation, inliers = cv2.solvePnPRansac(
            objects,
            seen,
            intrinsics,
            None,
            iterationsCount=200,
            reprojectionError=TOLERANCE * max(camera.height, camera.width),
            flags=cv2.SOLVEPNP_SQPNP,
        )
    except cv2.error:  # what it says of degenerate points
        return None
    if not found or inliers is None or len(inliers) < MIN_INLIERS * len(votes):
        return None
    inside = inliers[:, 0]
    rotation, translation = cv2.solvePnPRefineLM(
        objects[inside], seen[inside], intrinsics, None, rotation, translation
    )
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(rotation)[0], translation[:, 0]
    return torch.from_numpy(pose)


def pair_scale(
    predicted: Float[Tensor, "4 4"], known: Float[Tensor, "4 4"], typical_depth: float
) -> float | None:
    """Scene units per unit of the network, from first-to-second transforms in both.

    None where the predicted baseline is too short for points of `typical_depth`, or the transforms
    differ in more than their unit.
    """
    baselines = [-(pose[:3, :3].T @ pose[:3, 3]) for pose in (predicted, known)]
    lengths = [float(baseline.norm()) for baseline in baselines]
    if lengths[0] < math.tan(MIN_PARALLAX_RAD) * abs(typical_depth) or lengths[1] == 0:
        return None
    between = float(baselines[0] @ baselines[1]) / (lengths[0] * lengths[1])
    turn = float((predicted[:3, :3] @ known[:3, :3].T).trace() - 1) / 2
    if min(between, turn) < math.cos(MAX_CONTRADICTION_RAD):
        return None
    return lengths[1] / lengths[0]


def _depth_map(
    points: Float[Tensor, "h w 3"], sureness: Float[Tensor, "h w"], scale: float
) -> DepthMap:
    depth = points[..., 2] * scale
    known = (depth > 0) & depth.isfinite()
    return DepthMap(torch.where(known, depth, 0), torch.where(known, sureness, 0))
