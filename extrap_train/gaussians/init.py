"""Where Gaussians start: points from the depth source, triangulated from the inputs, or random.

Triangulation does what COLMAP's does. Tracks are connected components of pairwise matches; a track
with two features of one photograph contradicts itself and is dropped.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from torch import Tensor

from extrap_train.depth import DepthMap
from extrap_train.errors import InputError
from extrap_train.gaussians.gaussian_model import GaussianParameters, rgb_to_sh
from extrap_train.geometry.cameras import transform, unproject_to_world
from extrap_train.geometry.epipolar import (
    epipolar_lines,
    fundamental_matrix,
    homogeneous,
    viewing_rays,
)
from extrap_train.matching.sift import (
    Features,
    descriptor_distance,
    detect_sift,
    match_mutual,
    root_sift,
)
from extrap_train.views import Camera, View, combine

_MIN_SPACING = 1e-7**0.5
FARTHEST = 10.0
"""Greatest depth of random points, as a multiple of the scene centre's depth."""
NEAREST_UNKNOWN = 0.5
"""Least depth of random points, as a multiple of the scene centre's depth, where the inputs do not
tell (`nearest_expected`)."""


@dataclass(frozen=True)
class Points:
    """Coloured points in the frame that Gaussians are fitted in."""

    positions: Float[Tensor, "n 3"]
    colors: Float[Tensor, "n 3"]
    """In [0, 1]."""
    confidence: Float[Tensor, " n"]
    """As depth sources give it; 1 for points that do not come from depth."""

    def __len__(self) -> int:
        return len(self.positions)

    def __getitem__(self, index: Int[Tensor, " m"] | Bool[Tensor, " n"]) -> "Points":
        return combine([self], lambda tensors: tensors[0][index])

    def at_most(self, count: int, generator: torch.Generator) -> "Points":
        """All of them, or an even draw of `count`."""
        if len(self) <= count:
            return self
        return self[torch.randperm(len(self), generator=generator)[:count].sort().values]


def random_points(cameras: Sequence[Camera], count: int, generator: torch.Generator) -> Points:
    """Points that at least one input camera sees, in random colors.

    Even over the cameras, their pixels, and the logarithm of depth, from the nearest that can be
    expected to 10 times that of the scene's centre, which the frame puts at the origin:
    surroundings have no far end.
    """
    expected = nearest_expected(cameras)
    which = torch.randint(len(cameras), (count,), generator=generator)
    place = torch.rand(count, 3, generator=generator)
    positions = torch.empty(count, 3)
    for index, camera in enumerate(cameras):
        mine = which == index
        reach = max(float(camera.world_to_cam[2, 3]), 0.1)
        nearest = float(expected[index]) or NEAREST_UNKNOWN * reach
        depth = nearest * (FARTHEST * reach / nearest) ** place[mine, 2]
        pixels = place[mine, :2] * torch.tensor([camera.width, camera.height])
        rays = viewing_rays(pixels, camera)
        positions[mine] = transform(camera.cam_to_world, rays * depth[:, None])
    return Points(positions, torch.rand(count, 3, generator=generator), torch.ones(count))


def pixel_points(
    view: View, depth_map: DepthMap, wanted: Bool[Tensor, "h w"] | None = None
) -> Points:
    """One point per pixel of reliable depth, of those that are wanted."""
    known = depth_map.reliable() > 0
    if wanted is not None:
        known = known & wanted
    positions = unproject_to_world(depth_map.depth, view.camera)
    return Points(positions[known], view.image.permute(1, 2, 0)[known], depth_map.confidence[known])


def nearest_expected(cameras: Sequence[Camera]) -> Float[Tensor, " v"]:
    """Depth before which each camera of the frame has nothing in its picture; 0 if untold.

    Inputs around an object show it whole: it is inside the ball around the origin that a camera at
    distance d with a (lesser) field of view of 2α would see whole, d · sin α in radius, and begins
    at d · (1 − sin α). If one input does not have the origin in its picture, the inputs do not look
    at one thing, and all distances are 0.
    """
    sides = [_sides(camera) for camera in cameras]
    origins = [camera.world_to_cam[:3, 3] for camera in cameras]
    if not all((side @ origin > 0).all() for side, origin in zip(sides, origins, strict=True)):
        return cameras[0].world_to_cam.new_zeros(len(cameras))
    found = []
    for side, origin in zip(sides, origins, strict=True):
        half_rad = torch.asin(side[:, 2]).view(2, 2).mean(1).min()
        found.append(origin.norm() * (1 - torch.sin(half_rad)))
    return torch.stack(found)


def _sides(camera: Camera) -> Float[Tensor, "4 3"]:
    """Unit normals, inwards and in the camera's axes, of the planes through its picture's borders:
    left, right, top, bottom. A crop need not have the optical axis in its middle, or at all.
    """
    along = camera.intrinsics[:2]
    size = along.new_tensor([camera.width, camera.height])
    across = torch.stack([along, size[:, None] * camera.intrinsics[2] - along], 1)
    return torch.nn.functional.normalize(across.flatten(0, 1), dim=1)


MIN_SIDE = 512
"""Smaller photographs are enlarged to this longer side first: SIFT needs room for its octaves."""
CONTRAST_THRESHOLD = 0.02
RATIO = 0.8
"""Largest ratio of the nearest and second nearest distance in Lowe's test."""
EPIPOLAR_SHARE = 0.006
"""Farthest a match may lie from its epipolar line, as a share of the longer side."""

MAX_ERROR_SHARE = 0.006
"""Reprojection error from which a point is dropped, as a share of the image's longer side."""
MIN_ANGLE_RAD = 0.026
"""Smaller angles (1.5°) between a point's rays leave its depth open."""


def triangulate_points(views: Sequence[View]) -> Points:
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
    scale = max(1.0, MIN_SIDE / max(height, width))
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
    limits = [MAX_ERROR_SHARE * max(camera.height, camera.width) for camera in cameras]
    if (error > limits).any() or _widest_angle(point, cameras) < MIN_ANGLE_RAD:
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


def parameters_from_points(
    points: Points, sh_degree: int, opacity: float, widest: Float[Tensor, " n"] | float = math.inf
) -> GaussianParameters:
    """One round Gaussian a point, as wide as the distance to its three neighbours (3DGS), but at
    most `widest`.

    InputError without points, or where one is not finite.
    """
    if not len(points):
        raise InputError("no initial points in features or depth of the inputs; use init=random")
    if not (points.positions.isfinite().all() and points.colors.isfinite().all()):
        raise InputError("an initial point is not finite; check the depth and the poses given")
    count = len(points)
    spacing = nearest_neighbours(points.positions, 3)[0].square().mean(1).sqrt()
    spacing = torch.minimum(spacing, torch.as_tensor(widest))
    quats = torch.zeros(count, 4)
    quats[:, 0] = 1
    return GaussianParameters(
        means=points.positions.clone(),
        log_scales=spacing.log()[:, None].repeat(1, 3),
        quats=quats,
        opacity_logits=torch.full((count,), math.log(opacity / (1 - opacity))),
        sh_dc=rgb_to_sh(points.colors)[:, None],
        sh_rest=torch.zeros(count, (sh_degree + 1) ** 2 - 1, 3),
    )


def nearest_neighbours(
    positions: Float[Tensor, "n 3"], count: int
) -> tuple[Float[Tensor, "n k"], Int[Tensor, "n k"]]:
    """Distances (at least 3e-4) to the nearest other points, and which they are; k ≤ `count`.

    A point that is alone has itself at distance 1.
    """
    if len(positions) == 1:
        return positions.new_ones(1, 1), positions.new_zeros(1, 1, dtype=torch.long)
    count = min(count, len(positions) - 1)
    array = positions.detach().cpu().double().numpy()
    distance, index = KDTree(array).query(array, k=count + 1)
    found = torch.from_numpy(distance[:, 1:]).float().clamp_min(_MIN_SPACING)
    return found.to(positions.device), torch.from_numpy(index[:, 1:]).to(positions.device)
