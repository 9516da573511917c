"""The completed scene in the formats that other programs read: PLY, transforms.json, COLMAP."""

import io
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from plyfile import PlyData, PlyElement

from extrap_train.data.image_files import to_eight_bits
from extrap_train.figures import picture_names, save_picture
from extrap_train.geometry.cameras import WorldFrame
from extrap_train.geometry.foreign_cameras import colmap_from_world_to_cam, opengl_from_world_to_cam
from extrap_train.reconstruction.cloud import PointCloud
from extrap_train.reconstruction.global_map import GlobalMap, MapView
from extrap_train.store.atomic import write_atomic
from extrap_train.views import Camera

MAX_COLMAP_POINTS = 50_000
"""COLMAP's points only start a reconstruction: a text of millions helps nobody."""
DEPTH_UNIT = 0.001
"""Scene units per unit of the depth files: nerfstudio takes this one, whatever the file says."""


def write_cloud(cloud: PointCloud, path: Path) -> None:
    """Write a binary PLY: position, normal, colour (8 bits), confidence."""
    columns = [("x", "f4"), ("y", "f4"), ("z", "f4"), ("nx", "f4"), ("ny", "f4"), ("nz", "f4")]
    columns += [("red", "u1"), ("green", "u1"), ("blue", "u1"), ("confidence", "f4")]
    rows = np.empty(len(cloud), columns)
    values = np.c_[cloud.points.numpy(), cloud.normals.numpy(), to_eight_bits(cloud.colors)]
    for (name, _), column in zip(columns, [*values.T, cloud.confidence.numpy()], strict=True):
        rows[name] = column
    content = io.BytesIO()
    PlyData([PlyElement.describe(rows, "vertex")]).write(content)
    write_atomic(path, content.getvalue())


def write_views(scene_map: GlobalMap, world: WorldFrame, folder: Path) -> None:
    """Write every view's picture, depth and confidence under `views/`, and `transforms.json`.

    Depth is in units of `DEPTH_UNIT`.
    """
    entries = []
    for stem, view in zip(_stems(scene_map), scene_map.views, strict=True):
        save_picture(view.view.image, folder / "views" / f"{stem}.png")
        _write_array(view.depth * world.unit / DEPTH_UNIT, folder / "views" / f"{stem}.depth.npy")
        _write_array(view.confidence, folder / "views" / f"{stem}.confidence.npy")
        entries.append(_entry(view, stem, world.outside(view.camera)))
    content = {"camera_model": "PINHOLE", "ply_file_path": "cloud.ply", "frames": entries}
    write_atomic(folder / "transforms.json", (json.dumps(content, indent=1) + "\n").encode())


def write_colmap(scene_map: GlobalMap, world: WorldFrame, cloud: PointCloud, folder: Path) -> None:
    """Write a COLMAP text model to `colmap/sparse/0`, with `colmap/images` leading to `views/`.

    `cloud` is in the photographs' world; its points have no tracks.
    """
    cameras, images = [], []
    for number, (stem, view) in enumerate(zip(_stems(scene_map), scene_map.views, strict=True), 1):
        camera = world.outside(view.camera)
        k = camera.intrinsics.double()
        lens = " ".join(repr(float(x)) for x in (k[0, 0], k[1, 1], k[0, 2], k[1, 2]))
        cameras.append(f"{number} PINHOLE {camera.width} {camera.height} {lens}")
        quaternion, translation = colmap_from_world_to_cam(camera.world_to_cam.double())
        pose = " ".join(repr(float(x)) for x in (*quaternion, *translation))
        images.append(f"{number} {pose} {number} {stem}.png\n")
    model = folder / "colmap" / "sparse" / "0"
    _write_lines(model / "cameras.txt", cameras)
    _write_lines(model / "images.txt", images)
    stride = max(1, -(-len(cloud) // MAX_COLMAP_POINTS))
    _write_lines(model / "points3D.txt", _point_lines(cloud, range(0, len(cloud), stride)))
    link = folder / "colmap" / "images"
    if not link.is_symlink():
        link.symlink_to(Path("..") / "views")


def _point_lines(cloud: PointCloud, chosen: Sequence[int]) -> list[str]:
    points, colors = cloud.points.tolist(), to_eight_bits(cloud.colors).tolist()
    return [
        " ".join(map(str, (number, *points[i], *colors[i], 0)))
        for number, i in enumerate(chosen, 1)
    ]


def _stems(scene_map: GlobalMap) -> list[str]:
    """File names without suffix or white space, at which COLMAP would end a name."""
    names = picture_names([view.view.name for view in scene_map.views])
    return [f"{number:03d}_{name}" for number, name in enumerate(names)]


def _entry(view: MapView, stem: str, camera: Camera) -> dict[str, object]:
    k = camera.intrinsics
    return {
        "file_path": f"views/{stem}.png",
        "depth_file_path": f"views/{stem}.depth.npy",
        "depth_unit_scale_factor": DEPTH_UNIT,
        "transform_matrix": opengl_from_world_to_cam(camera.world_to_cam.double()).tolist(),
        "w": camera.width,
        "h": camera.height,
        "fl_x": float(k[0, 0]),
        "fl_y": float(k[1, 1]),
        "cx": float(k[0, 2]),
        "cy": float(k[1, 2]),
        "origin": view.origin.kind,
        "made_from": list(view.origin.references),
    }


def _write_array(values: torch.Tensor, path: Path) -> None:
    content = io.BytesIO()
    np.save(content, values.numpy().astype(np.float32))
    write_atomic(path, content.getvalue())


def _write_lines(path: Path, lines: Sequence[str]) -> None:
    write_atomic(path, ("\n".join(lines) + "\n").encode())
