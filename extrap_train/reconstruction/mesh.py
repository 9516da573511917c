"""A mesh of the completed scene: where the views' truncated signed distances, averaged on a grid,
pass through zero (Curless and Levoy 1996), by marching cubes.

Only where views have looked is there a surface: the mesh ends where nobody has seen further, and
holes stay open.
"""

from pathlib import Path

import numpy as np
import torch
import trimesh
from jaxtyping import Float
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes
from torch import Tensor
from trimesh.exchange.ply import export_ply

from extrap_train.data.image_files import to_eight_bits
from extrap_train.geometry.cameras import WorldFrame
from extrap_train.reconstruction.cloud import PointCloud
from extrap_train.reconstruction.fusion import signed_distance
from extrap_train.reconstruction.global_map import GlobalMap
from extrap_train.store.atomic import write_atomic

_REACH = 0.6
"""Half the side of the box around the centre that the cameras look at, from a distance of 1."""
_CELL = 0.0075
_TRUNCATION = 0.03
"""Truncation of distances as a share of depth: about four cells at the middle, so that surfaces
seen aslant have whole cells, too."""
_MARGIN = 2
_AT_ONCE = 2**19
_MIN_WEIGHT = 0.2
"""Least weight of all views together: where it is less, space counts as unseen."""
_COLORED_BY = 8
"""Points of the cloud: one alone may be of an outline, where colours mix."""
_FROM_CLOUD = 4 * _CELL
"""Surfaces further from every point of the cloud are only where views contradict each other."""
_MIN_SHARE = 0.01
"""Least share of all faces for a piece of the mesh to be kept."""


def write_mesh(scene_map: GlobalMap, world: WorldFrame, cloud: PointCloud, path: Path) -> int:
    """Write the mesh as a binary PLY in the photographs' world; returns its number of faces.

    `cloud` is the map's, in the map's world. There is no file where there is no surface.
    """
    mesh = mesh_of(scene_map, cloud)
    if not len(mesh.faces):
        path.unlink(missing_ok=True)
        return 0
    mesh.vertices = world.points_outside(torch.from_numpy(np.array(mesh.vertices))).numpy()
    write_atomic(path, export_ply(mesh))
    return len(mesh.faces)


def mesh_of(scene_map: GlobalMap, cloud: PointCloud) -> trimesh.Trimesh:
    """The surface that the cameras circle, in the map's world, in the colours of the cloud; its
    faces look towards the cameras. Empty where there is none.
    """
    near = cloud[(cloud.points.abs() <= _REACH).all(1)]
    if len(near) < _COLORED_BY:
        return trimesh.Trimesh()
    low, high = near.points.amin(0) - _MARGIN * _CELL, near.points.amax(0) + _MARGIN * _CELL
    counts = [int(n) + 1 for n in (high - low) / _CELL]
    mean, weight = _mean_distance(scene_map, low, counts)
    seen = weight >= _MIN_WEIGHT
    whole = seen.clone()  # a cell by its upper corner, as marching cubes asks for it
    for axis in range(3):
        whole &= whole.roll(1, axis)
    try:
        vertices, faces, _, _ = marching_cubes(mean.numpy(), 0.0, mask=whole.numpy())
    except (ValueError, RuntimeError):  # no whole cell that the surface passes through
        return trimesh.Trimesh()
    points = low.numpy() + _CELL * vertices
    distances, nearest = cKDTree(near.points.numpy()).query(points, _COLORED_BY)
    colors = to_eight_bits(near.colors[nearest].mean(1))
    mesh = trimesh.Trimesh(points, faces, vertex_colors=colors, process=False)
    mesh.update_faces((distances[:, 0] <= _FROM_CLOUD)[faces].all(1))
    return _without_crumbs(mesh)


def _mean_distance(
    scene_map: GlobalMap, low: Float[Tensor, "3"], counts: list[int]
) -> tuple[Float[Tensor, "x y z"], Float[Tensor, "x y z"]]:
    """Signed distance to the surface at the grid's corners, in truncations, and its weight."""
    axes = [low[i] + _CELL * torch.arange(n) for i, n in enumerate(counts)]
    means, weights = [], []
    for points in torch.cartesian_prod(*axes).split(_AT_ONCE):
        total, weight = torch.zeros(len(points)), torch.zeros(len(points))
        for view in scene_map.views:
            distance, confidence = signed_distance(points, view, _TRUNCATION)
            total += confidence * distance
            weight += confidence
        means.append(total / weight.clamp(min=1e-30))
        weights.append(weight)
    return torch.cat(means).view(counts), torch.cat(weights).view(counts)


def _without_crumbs(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mesh without pieces of next to no faces, which a few wrong pixels leave behind."""
    pieces = trimesh.graph.connected_components(mesh.face_adjacency, min_len=1)
    kept = [piece for piece in pieces if len(piece) >= _MIN_SHARE * len(mesh.faces)]
    mesh.update_faces(np.concatenate([np.empty(0, int), *kept]))
    mesh.remove_unreferenced_vertices()
    return mesh
