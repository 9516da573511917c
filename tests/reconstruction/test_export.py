"""What a completed scene leaves behind, re-read by the rules of the programs that it is for."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scenes
import torch
import trimesh
from PIL import Image
from plyfile import PlyData

from extrap_train.data.transforms_json import read_transforms
from extrap_train.geometry.cameras import WorldFrame, unproject_to_world
from extrap_train.reconstruction.cloud import cloud_of
from extrap_train.reconstruction.export import write_cloud, write_colmap, write_views
from extrap_train.reconstruction.global_map import GENERATED, GIVEN, GlobalMap, Origin
from extrap_train.views import View

_SIZE = 40
_RADIUS = 0.6
_SCENE = scenes.Scene((scenes.sphere(_RADIUS),))
_UNIT = WorldFrame(torch.tensor([3.0, -1.0, 0.5]), 2.5)
_NAMES = [
    "IMG 003 (edited).jpg",
    "IMG_003__edited_.jpg",  # the same once cleaned
    "photo\u3000one\u00a0two\tthree.png",
    "Stühle im März.JPG",
    "写真/写真.jpeg",
    "e\u0301te\u0301.png",
    "x" * 250 + ".png",
    "azimuth 30",
    "line\nbreak.png",
    "-o v.1.png",
]


@pytest.fixture(scope="module")
def known() -> GlobalMap:
    grown = GlobalMap(0.01)
    for index, name in enumerate(_NAMES):
        camera = scenes.orbit_camera(36.0 * index, size=_SIZE)
        view = View(_SCENE.image(camera), camera, _SCENE.depth(camera), name=name)
        origin = Origin(GENERATED if index else GIVEN, root=0)
        grown, _ = grown.added(view, torch.ones(_SIZE, _SIZE), origin)
    return grown


@pytest.fixture(scope="module")
def folder(known: GlobalMap, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("completed")
    cloud = cloud_of(known)
    cloud = replace(cloud, points=_UNIT.points_outside(cloud.points))
    write_views(known, _UNIT, folder)
    write_cloud(cloud, folder / "cloud.ply")
    write_colmap(known, _UNIT, cloud, folder)
    return folder


def _outside(known: GlobalMap) -> list[np.ndarray]:
    return [_UNIT.outside(view.camera).world_to_cam.double().numpy() for view in known.views]


def test_every_name_is_one_word_and_used_once(folder: Path) -> None:
    names = [path.name for path in (folder / "views").iterdir()]
    assert len({name.lower() for name in names}) == 3 * len(_NAMES)
    for name in names:
        assert len(name.split()) == 1
        assert len(name.encode()) <= 255


def test_colmap_reads_the_cameras_and_finds_the_pictures(folder: Path, known: GlobalMap) -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="needs pycolmap: the extra `dev`")
    model = pycolmap.Reconstruction(str(folder / "colmap" / "sparse" / "0"))
    images = sorted(model.images.values(), key=lambda image: image.name)
    assert len(images) == len(known)
    for image, view, world_to_cam in zip(images, known.views, _outside(known), strict=True):
        with Image.open(folder / "colmap" / "images" / image.name) as picture:
            pixels = np.asarray(picture)
        camera = model.cameras[image.camera_id]
        assert camera.model.name == "PINHOLE"
        assert (camera.height, camera.width) == pixels.shape[:2]
        assert np.allclose(camera.calibration_matrix(), view.camera.intrinsics, atol=1e-6)
        assert np.allclose(image.cam_from_world().matrix(), world_to_cam[:3], atol=1e-6)
        assert np.abs(pixels / 255 - view.view.image.permute(1, 2, 0).numpy()).max() <= 0.51 / 255
    points = np.array([point.xyz for point in model.points3D.values()])
    distance = np.linalg.norm(points - _UNIT.center.numpy(), axis=1) / _UNIT.unit
    assert len(points) > 100
    assert np.abs(distance - _RADIUS).max() < 0.01


def test_nerfstudio_finds_pictures_and_depths_on_the_surface(folder: Path) -> None:
    """By the rules of its data parser, in NumPy alone; its unit of depth is an option of the
    parser, 0.001, and not what the file says."""
    content = json.loads((folder / "transforms.json").read_text())
    assert content["camera_model"] == "PINHOLE"
    assert len(content["frames"]) == len(_NAMES)
    for frame in content["frames"]:
        assert frame["depth_unit_scale_factor"] == 0.001
        with Image.open(folder / frame["file_path"]) as picture:
            assert picture.size == (frame["w"], frame["h"])
        depth = np.load(folder / frame["depth_file_path"]) * 1e-3
        cam_to_world = np.array(frame["transform_matrix"])
        v, u = np.mgrid[: frame["h"], : frame["w"]] + 0.5
        x = (u - frame["cx"]) / frame["fl_x"]
        y = -(v - frame["cy"]) / frame["fl_y"]
        rays = np.stack([x, y, -np.ones_like(x)], -1)  # x right, y up, looking along -z
        points = (rays * depth[..., None]) @ cam_to_world[:3, :3].T + cam_to_world[:3, 3]
        distance = np.linalg.norm(points[depth > 0] - _UNIT.center.numpy(), axis=1)
        assert (depth > 0).any()
        assert np.abs(distance / _UNIT.unit - _RADIUS).max() < 1e-4
    cloud = PlyData.read(folder / content["ply_file_path"])["vertex"]
    points = np.stack([cloud[axis] for axis in "xyz"], 1)
    distance = np.linalg.norm(points - _UNIT.center.numpy(), axis=1)
    assert len(points) > 100
    assert np.abs(distance / _UNIT.unit - _RADIUS).max() < 0.01
    assert cloud["red"].dtype == np.uint8


def test_trimesh_reads_the_cloud_with_its_colours(folder: Path, known: GlobalMap) -> None:
    read = trimesh.load(folder / "cloud.ply")
    assert isinstance(read, trimesh.PointCloud)
    cloud = cloud_of(known)
    assert np.allclose(read.vertices, _UNIT.points_outside(cloud.points), atol=1e-5)
    assert np.abs(np.array(read.colors)[:, :3] / 255 - cloud.colors.numpy()).max() <= 0.51 / 255


def test_our_own_reader_agrees(folder: Path) -> None:
    frames = read_transforms(folder).frames
    assert len(frames) == len(_NAMES)
    for frame in frames:
        view = frame.load()
        assert view.depth is not None
        points = unproject_to_world(view.depth, view.camera)[view.depth > 0]
        distance = (points - _UNIT.center).norm(dim=-1) / _UNIT.unit
        assert (distance - _RADIUS).abs().max() < 1e-4
