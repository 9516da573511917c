"""The mesh of a map whose surfaces are known exactly, re-read by trimesh."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scenes
import torch
import trimesh

from extrap_train.geometry.cameras import WorldFrame
from extrap_train.reconstruction.cloud import cloud_of
from extrap_train.reconstruction.global_map import GIVEN, GlobalMap, Origin
from extrap_train.reconstruction.mesh import mesh_of, write_mesh
from extrap_train.views import View

_RADIUS = 0.3
_WORLD = WorldFrame(torch.tensor([3.0, -1.0, 0.5]), 2.5)
_VIEWS = 8


def _map_of(sphere: scenes.Hit) -> GlobalMap:
    scene, known = scenes.Scene((sphere,)), GlobalMap(0.01)
    for index in range(_VIEWS):
        elevation = 60.0 if index % 2 else -60.0
        camera = scenes.orbit_camera(360 / _VIEWS * index, 1.0, elevation, size=64)
        view = View(scene.image(camera), camera, scene.depth(camera), name=str(index))
        known, _ = known.added(view, torch.ones(64, 64), Origin(GIVEN, root=0))
    return known


@pytest.fixture(scope="module")
def known() -> GlobalMap:
    return _map_of(scenes.sphere(_RADIUS))


@pytest.fixture(scope="module")
def read(known: GlobalMap, tmp_path_factory: pytest.TempPathFactory) -> trimesh.Trimesh:
    path = tmp_path_factory.mktemp("mesh") / "mesh.ply"
    faces = write_mesh(known, _WORLD, cloud_of(known), path)
    read = trimesh.load(path)
    assert len(read.faces) == faces
    return read


def test_it_lies_on_the_surface_all_around_and_looks_outwards(read: trimesh.Trimesh) -> None:
    points = (read.vertices - _WORLD.center.numpy()) / _WORLD.unit
    distance = np.linalg.norm(points, axis=1)
    assert np.abs(distance - _RADIUS).max() < 0.01  # a cell and a third
    assert np.abs(distance - _RADIUS).mean() < 0.002
    assert read.area == pytest.approx(4 * np.pi * (_RADIUS * _WORLD.unit) ** 2, rel=0.1)
    outwards = (read.face_normals * (read.triangles_center - _WORLD.center.numpy())).sum(1)
    assert (outwards > 0).mean() > 0.99


def test_its_colours_are_those_of_the_views(read: trimesh.Trimesh, known: GlobalMap) -> None:
    view = known.views[0]
    inside = torch.from_numpy((read.vertices - _WORLD.center.numpy()) / _WORLD.unit).float()
    seen = view.camera.world_to_cam[:3, :3] @ inside.T + view.camera.world_to_cam[:3, 3:]
    pixels = (view.camera.intrinsics @ seen)[:2] / seen[2]
    column, row = pixels.floor().long()
    front = (seen[2] - view.depth[row, column]).abs() < 0.01
    shown = view.view.image[:, row, column].T[front]
    colors = torch.from_numpy(np.array(read.visual.vertex_colors)[:, :3]).float()[front] / 255
    assert front.sum() > 1000
    assert (shown - colors).abs().mean() < 0.05


def test_nobody_has_looked_where_it_ends(known: GlobalMap) -> None:
    half = replace(known, views=known.views[:1])
    mesh = mesh_of(half, cloud_of(half))
    towards = mesh.vertices @ half.views[0].camera.cam_to_world[:3, 3].numpy()
    assert len(mesh.faces) > 1000
    assert towards.min() > 0  # of a ball, the half that the camera sees


def test_a_few_points_alone_are_no_surface(known: GlobalMap) -> None:
    cloud = cloud_of(known)
    assert not len(mesh_of(known, cloud[:7]).faces)
    blind = replace(known, views=[replace(v, confidence=0 * v.confidence) for v in known.views])
    assert not len(mesh_of(blind, cloud).faces)


def test_there_is_no_file_without_a_surface_in_the_middle(tmp_path: Path) -> None:
    known = _map_of(scenes.sphere(0.2, (0.0, 0.0, 40.0)))
    path = tmp_path / "mesh.ply"
    path.write_text("of an earlier run")
    assert write_mesh(known, _WORLD, cloud_of(known), path) == 0
    assert not path.exists()
