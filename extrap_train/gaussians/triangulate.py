"""Sparse points from the input photographs at their known poses (what COLMAP's triangulator does).

Tracks are connected components of pairwise matches; a track that holds two features of one
photograph contradicts itself and is dropped.
"""

from collections.abc import Sequence
from itertools import combinations

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from extrap_train.gaussians.points import Points
from extrap_train.geometry.epipolar import epipolar_lines, fundamental_matrix, homogeneous
from extrap_train.matching.sift import (
    Features,
    descriptor_distance,
    detect_sift,
    match_mutual,
    root_sift,
)
from extrap_train.views import Camera, View

LEAST_SIDE = 512
"""Smaller photographs are enlarged to this longer side first: SIFT needs room for its octaves."""
CONTRAST_THRESHOLD = 0.02
RATIO = 0.8
"""Of Lowe's test."""
EPIPOLAR_SHARE = 0.006
"""Farthest a match may lie from its epipolar line, as a share of the longer side."""

LARGEST_ERROR_SHARE = 0.006
"""Reprojection error from which a point is dropped, as a share of the image's longer side."""
LEAST_ANGLE_RAD = 0.026
"""Smaller angles (1.5°) between a point's rays leave its depth open."""


def triangulated_points(views: Sequence[View]) -> Points:
    """Points that at least two of the views agree on, in the mean colour of their pixels.

    No point at all is a possible answer: views that are far apart share no SIFT features.
    """
    features = [_detect(view) for view in views]
    found = [_point(track, features, views) for track in _tracks(features, views)]
    rows = np.array([row for row in found if row is not None]).reshape(-1, 6)
    table = torch.from_numpy(rows).float()
    return Points(table[:, :3], table[:, 3:], torch.ones(len(table)))


def _detect(view: View) -> Features:
    """RootSIFT features at a size that leaves SIFT its octaves."""
    height, width = view.image.shape[1:]
    scale = max(1.0, LEAST_SIDE / max(height, width))
    size = round(height * scale), round(width * scale)
    return root_sift(detect_sift(view.image, size, contrast_threshold=CONTRAST_THRESHOLD))


def _match(
    first: Features, second: Features, cameras: tuple[Camera, Camera]
) -> Int[np.ndarray, "m 2"]:
    """Mutual matches among the features on each other's epipolar lines."""
    lines = epipolar_lines(first.pixels, fundamental_matrix(*cameras))
    off_line = np.abs(lines @ homogeneous(second.pixels).T)
    limit = EPIPOLAR_SHARE * max(cameras[1].height, cameras[1].width)
    distance = descriptor_distance(first, second)
    return match_mutual(np.where(off_line > limit, np.inf, distance), RATIO)


def _tracks(features: Sequence[Features], views: Sequence[View]) -> list[Int[np.ndarray, "k 2"]]:
    """(view, feature) of every track that is consistent, in a fixed order."""
    starts = np.cumsum([0, *(len(each.pixels) for each in features)])
    edges = [np.zeros((0, 2), np.int64)]
    for i, j in combinations(range(len(views)), 2):
        pairs = _match(features[i], features[j], (views[i].camera, views[j].camera))
        edges.append(pairs + starts[[i, j]])
    first, second = np.concatenate(edges).T
    size = starts[-1]
    graph = coo_matrix((np.ones(len(first)), (first, second)), shape=(size, size))
    label = connected_components(graph, directed=False)[1] if size else np.zeros(0, np.int64)
    members = np.flatnonzero(np.bincount(label, minlength=1)[label] > 1)
    members = members[np.argsort(label[members], kind="stable")]
    groups = np.split(members, np.flatnonzero(np.diff(label[members])) + 1)
    tracks = []
    for group in groups:
        view = np.searchsorted(starts, group, side="right") - 1
        if len(group) and len(set(view)) == len(view):
            tracks.append(np.stack([view, group - starts[view]], 1))
    return tracks


def _point(
    track: Int[np.ndarray, "k 2"], features: Sequence[Features], views: Sequence[View]
) -> Float[np.ndarray, "6"] | None:
    """Position and colour of a track's point; None where its rays do not meet."""
    seen = [views[view] for view, _ in track]
    cameras = [view.camera for view in seen]
    pixels = np.stack([features[view].pixels[feature] for view, feature in track])
    projections = projection_matrices(cameras)
    point = triangulate(pixels, projections)
    cam = projections @ np.append(point, 1)
    if not np.isfinite(point).all() or (cam[:, 2] <= 0).any():
        return None
    error = np.linalg.norm(cam[:, :2] / cam[:, 2:] - pixels, axis=1)
    limits = [LARGEST_ERROR_SHARE * max(camera.height, camera.width) for camera in cameras]
    if (error > limits).any() or _widest_angle(point, cameras) < LEAST_ANGLE_RAD:
        return None
    return np.append(point, _color(pixels, seen))


def triangulate(
    pixels: Float[np.ndarray, "k 2"], projections: Float[np.ndarray, "k 3 4"]
) -> Float[np.ndarray, "3"]:
    """The point whose projections are nearest to the pixels.

    Linear (Hartley and Zisserman, 12.2), then Gauss-Newton on the reprojection error.
    """
    rows = pixels[:, :, None] * projections[:, 2:, :] - projections[:, :2, :]
    rows = rows / np.linalg.norm(rows[..., :3], axis=-1, keepdims=True)
    solution = np.linalg.svd(rows.reshape(-1, 4))[2][-1]
    with np.errstate(divide="ignore", invalid="ignore"):
        point = solution[:3] / solution[3]
    for _ in range(3):
        if not np.isfinite(point).all():
            break
        point = point - _newton_step(point, pixels, projections)
    return point


def _newton_step(
    point: Float[np.ndarray, "3"],
    pixels: Float[np.ndarray, "k 2"],
    projections: Float[np.ndarray, "k 3 4"],
) -> Float[np.ndarray, "3"]:
    cam = projections @ np.append(point, 1)
    depth = np.where(np.abs(cam[:, 2:]) < 1e-12, 1e-12, cam[:, 2:])
    seen = cam[:, :2] / depth
    rows = projections[:, :2, :3] - seen[..., None] * projections[:, 2:, :3]
    jacobian = rows / depth[..., None]
    return np.linalg.lstsq(jacobian.reshape(-1, 3), (seen - pixels).ravel(), rcond=None)[0]


def _widest_angle(point: Float[np.ndarray, "3"], cameras: Sequence) -> float:
    rays = point - np.stack([camera.center.double().numpy() for camera in cameras])
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
    return float(np.arccos(np.clip((rays @ rays.T).min(), -1, 1)))


def _color(pixels: Float[np.ndarray, "k 2"], views: Sequence[View]) -> Float[np.ndarray, "3"]:
    colors = []
    for (u, v), view in zip(pixels, views, strict=True):
        row = min(max(int(v), 0), view.camera.height - 1)
        column = min(max(int(u), 0), view.camera.width - 1)
        colors.append(view.image[:, row, column].double().numpy())
    return np.mean(colors, axis=0)


def projection_matrices(cameras: Sequence[Camera]) -> Float[np.ndarray, "k 3 4"]:
    """`K [R | t]` of every camera, in float64."""
    rows = [c.intrinsics.double() @ c.world_to_cam[:3].double() for c in cameras]
    return torch.stack(rows).numpy()
