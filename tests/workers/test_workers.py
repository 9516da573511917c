"""The workers against stand-ins with the published interface of their networks: the weights of
these are not here.
"""

import importlib
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import roma
import torch
from PIL import Image
from posed_folders import to_bytes, write_transforms
from traced_scenes import SCENES, orbit_camera, render

from extrap_train import open_views, warp_view
from extrap_train.config import FilesDepthConfig
from extrap_train.data.scene_spec import open_scene
from extrap_train.errors import InputError
from extrap_train.views import Camera

WORKERS = Path(__file__).parents[2] / "workers"
SCENE = SCENES["box on the ground"]
UNIT = 0.3
"""Of the stand-ins' depth, in scene units."""
CAMERAS = [orbit_camera(azimuth, 128).cropped(19, 0, 90, 128) for azimuth in (0, 12, 24)]


STEPS = [camera.world_to_cam @ CAMERAS[0].cam_to_world for camera in CAMERAS]
"""Here, not in the networks, where products may have few bits."""


def own_camera(index: int, height: int, width: int) -> Camera:
    """What a network says that finds cameras: the first is the world, in its own unit."""
    step = STEPS[index].clone()
    step[:3, 3] /= UNIT
    return replace(CAMERAS[index].resized(height, width), world_to_cam=step)


def exact(index: int, height: int, width: int) -> torch.Tensor:
    return render(SCENE, CAMERAS[index].resized(height, width)).depth / UNIT


class DepthAnything3(torch.nn.Module):
    """`forward` of depth_anything_3.api; images are (batch, views, 3, height, width)."""

    @classmethod
    def from_pretrained(cls, weights):
        assert weights == "depth-anything/DA3-BASE"
        return cls()

    def input_processor(self, image, extrinsics, intrinsics, process_res, process_res_method):
        assert (process_res, process_res_method) == (504, "upper_bound_resize")
        pixels = torch.from_numpy(np.stack(image)).permute(0, 3, 1, 2) / 255
        cameras = (extrinsics, intrinsics)
        return pixels, *(None if x is None else torch.from_numpy(x).float() for x in cameras)

    def forward(self, image, extrinsics=None, intrinsics=None, export_feat_layers=None):
        assert export_feat_layers == []
        _, count, _, height, width = image.shape
        depth = torch.stack([exact(i, height, width) for i in range(count)])[None]
        output = {"depth": depth, "depth_conf": torch.full_like(depth, 4.0)}
        if extrinsics is None:
            own = [own_camera(index, height, width) for index in range(count)]
            poses = torch.stack([camera.world_to_cam[:3] for camera in own])[None]
            lenses = torch.stack([camera.intrinsics for camera in own])[None]
            return output | {"extrinsics": poses, "intrinsics": lenses}
        steps = [torch.linalg.inv(step) for step in STEPS]
        unit = torch.stack([step[:3, 3].norm() for step in steps]).median().clamp_min(0.1)
        for index, camera in enumerate(CAMERAS):
            k = camera.resized(height, width).intrinsics
            torch.testing.assert_close(intrinsics[0, index], k, rtol=1e-4, atol=1e-3)
            step = torch.linalg.inv(extrinsics[0, index])
            torch.testing.assert_close(step[:3, :3], steps[index][:3, :3], rtol=0, atol=1e-5)
            torch.testing.assert_close(step[:3, 3] * unit, steps[index][:3, 3], rtol=0, atol=1e-5)
        return output


class MapAnything(torch.nn.Module):
    """`infer` of mapanything.models: a list of views with batches of one."""

    @classmethod
    def from_pretrained(cls, weights):
        assert weights == "facebook/map-anything-apache"
        return cls()

    def infer(self, views, apply_mask=True):
        predictions = []
        for index, view in enumerate(views):
            height, width = view["img"].shape[2:]
            camera = CAMERAS[index].resized(height, width)
            if "intrinsics" in view:
                torch.testing.assert_close(
                    view["intrinsics"][0], camera.intrinsics, rtol=1e-4, atol=1e-3
                )
                torch.testing.assert_close(view["camera_poses"][0], camera.cam_to_world)
                assert not view["is_metric_scale"].item()
            own = own_camera(index, height, width)
            depth = exact(index, height, width)[None]
            mask = torch.ones_like(depth, dtype=torch.bool)
            mask[:, :7] = False
            conf = torch.full_like(depth, 4.0)
            maps = {"depth_z": depth[..., None], "conf": conf, "mask": mask[..., None]}
            cameras = {"intrinsics": own.intrinsics, "camera_poses": own.cam_to_world}
            predictions.append(maps | {name: x[None] for name, x in cameras.items()})
        return predictions


def preprocess_inputs(views, resize_mode, size):
    """That of mapanything.utils.image for pictures that have the size already."""
    assert resize_mode == "fixed_size"
    assert all(view["img"].shape == (size[1], size[0], 3) for view in views)
    return [
        view
        | {"img": view["img"].permute(2, 0, 1)[None] / 255}
        | {name: view[name][None] for name in ("intrinsics", "camera_poses") if name in view}
        for view in views
    ]


class VGGT(torch.nn.Module):
    """vggt.models.vggt; images are (views, 3, height, width) in [0, 1]."""

    @classmethod
    def from_pretrained(cls, weights):
        assert weights == "facebook/VGGT-1B"
        return cls()

    def forward(self, images):
        count, _, height, width = images.shape
        assert height % 14 == width % 14 == 0
        assert 0 <= images.min() < images.max() <= 1
        depth = torch.stack([exact(i, height, width) for i in range(count)])[None]
        own = [own_camera(i, height, width) for i in range(count)]
        encoded = [
            torch.cat([pose[:3, 3], roma.rotmat_to_unitquat(pose[:3, :3]), _fields(camera)])
            for pose, camera in ((camera.world_to_cam, camera) for camera in own)
        ]
        return {
            "depth": depth[..., None],
            "depth_conf": torch.full_like(depth, 4.0),
            "pose_enc": torch.stack(encoded)[None],
        }


def _fields(camera):
    """Vertical and horizontal field of view."""
    size = torch.tensor([camera.height, camera.width])
    return 2 * torch.atan(size / 2 / camera.intrinsics.diagonal()[:2].flip(0))


def pose_encoding_to_extri_intri(pose_encoding, image_size_hw):
    """That of vggt.utils.pose_enc: translation, quaternion (scalar last) and fields of view."""
    height, width = image_size_hw
    turn = roma.unitquat_to_rotmat(pose_encoding[..., 3:7])
    poses = torch.cat([turn, pose_encoding[..., :3, None]], -1)
    k = torch.zeros_like(turn)
    k[..., 1, 1], k[..., 0, 0] = (
        side / 2 / torch.tan(field / 2)
        for side, field in zip((height, width), pose_encoding[..., 7:].unbind(-1), strict=True)
    )
    k[..., 0, 2], k[..., 1, 2], k[..., 2, 2] = width / 2, height / 2, 1
    return poses, k


STAND_INS = {
    "depth_anything_3.api": {"DepthAnything3": DepthAnything3},
    "mapanything.models": {"MapAnything": MapAnything},
    "mapanything.utils.image": {"preprocess_inputs": preprocess_inputs},
    "vggt.models.vggt": {"VGGT": VGGT},
    "vggt.utils.pose_enc": {"pose_encoding_to_extri_intri": pose_encoding_to_extri_intri},
}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A folder that `scene=` takes."""
    folder = tmp_path_factory.mktemp("scene") / "capture"
    views = [render(SCENE, camera) for camera in CAMERAS]
    write_transforms(folder, [replace(view, mask=torch.ones_like(view.depth)) for view in views])
    return folder


@pytest.fixture
def load(monkeypatch):
    """A worker's module as the script sees it: with its own folder and the networks' packages."""
    for name, content in STAND_INS.items():
        for length in range(1, name.count(".") + 2):
            package = ".".join(name.split(".")[:length])
            if package not in sys.modules:
                monkeypatch.setitem(sys.modules, package, ModuleType(package))
        vars(sys.modules[name]).update(content)
    monkeypatch.syspath_prepend(str(WORKERS))
    monkeypatch.setitem(sys.modules, "scene_folder", importlib.import_module("scene_folder"))
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    return importlib.import_module


@pytest.mark.parametrize("worker", ["run_depth_anything_3", "run_map_anything", "run_vggt"])
def test_a_worker_gives_the_exact_warp(scene, tmp_path, load, worker):
    photographs, depth = str(tmp_path / "photographs"), str(tmp_path / "depth")
    load("write_photographs").write_photographs(str(scene), photographs)
    load(worker).estimate_depth(photographs, depth)
    names = sorted(path.relative_to(depth).as_posix() for path in Path(depth).rglob("*.npz"))
    assert names == ["images/000.npz", "images/001.npz", "images/002.npz"]
    views = open_views(str(scene), depth=FilesDepthConfig(folder=depth, image_size=90), size=90)
    truth = [replace(view, depth=render(SCENE, view.camera).depth) for view in views]
    for view, true in zip(views, truth, strict=True):
        known = view.depth > 0
        assert known.float().mean() > 0.85
        assert (view.depth / true.depth - 1).abs()[known].median() < 0.01
    warp, wanted = (warp_view(given[:2], views[2].camera, size=90) for given in (views, truth))
    both = (warp.mask * wanted.mask)[:, None]
    assert both.mean() > 0.5
    assert ((warp.image - wanted.image).abs() * both).mean() < 0.02


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    """The photographs alone, one of them stored on its side and one with a mask beside it."""
    folder = tmp_path_factory.mktemp("photographs")
    for index, camera in enumerate(CAMERAS):
        picture = Image.fromarray(to_bytes(render(SCENE, camera).image.permute(1, 2, 0)))
        exif = Image.Exif()
        if index == 1:
            exif[0x0112] = 6
            picture = picture.transpose(Image.Transpose.ROTATE_90)
        picture.save(folder / f"{index}.png", exif=exif)
    Image.new("L", (128, 90), 255).save(folder / "0_mask.png")
    return str(folder)


@pytest.mark.parametrize("worker", ["run_depth_anything_3", "run_map_anything", "run_vggt"])
def test_photographs_without_cameras_become_a_scene(photographs, tmp_path, load, worker):
    folder = str(tmp_path / "scene")
    load(worker).estimate_depth(photographs, folder)
    sequence = open_scene(folder)
    assert [frame.path for frame in sequence.frames] == [f"images/{i}.png" for i in range(3)]
    assert "transforms.json" in sequence.poses
    for index, frame in enumerate(sequence.frames):
        own = own_camera(index, 90, 128)
        torch.testing.assert_close(frame.camera.intrinsics, own.intrinsics, rtol=1e-3, atol=0.1)
        torch.testing.assert_close(frame.camera.world_to_cam, own.world_to_cam, rtol=0, atol=1e-4)
    views = open_views(
        folder, depth=FilesDepthConfig(folder=f"{folder}/depth", image_size=90), size=90
    )
    truth = []
    for view, camera in zip(views, CAMERAS, strict=True):
        true = render(SCENE, replace(view.camera, world_to_cam=camera.world_to_cam)).depth / UNIT
        truth.append(replace(view, depth=true))
        known = view.depth > 0
        assert known.float().mean() > 0.85
        assert (view.depth / true - 1).abs()[known].median() < 0.01
    warp, wanted = (warp_view(given[:2], views[2].camera, size=90) for given in (views, truth))
    both = (warp.mask * wanted.mask)[:, None]
    assert both.mean() > 0.5
    assert ((warp.image - wanted.image).abs() * both).mean() < 0.02
    assert ((warp.image - views[2].image).abs() * both).mean() < 0.05  # another view: 0.15


def test_the_photographs_folder_is_not_written_to(photographs, load):
    with pytest.raises(SystemExit, match="another folder"):
        load("run_vggt").estimate_depth(photographs, photographs)
    assert not Path(photographs, "transforms.json").exists()


def test_photographs_are_chosen_by_name(scene, tmp_path, load):
    write = load("write_photographs").write_photographs
    write(str(scene), str(tmp_path), "001.png")
    assert [path.name for path in tmp_path.rglob("*.npz")] == ["001.npz"]
    with pytest.raises(InputError, match="another folder"):  # a network would see both
        write(str(scene), str(tmp_path), "002.png")
    with pytest.raises(InputError, match="nine"):
        write(str(scene), str(tmp_path / "new"), "nine.png")


def test_photographs_of_several_sizes_are_refused(tmp_path, load):
    read = load("scene_folder").read_photographs
    with pytest.raises(SystemExit, match="0 photographs"):
        read(str(tmp_path), 70)
    for side in (70, 140):
        camera = SimpleNamespace(intrinsics=np.eye(3), world_to_cam=np.eye(4))
        image = np.zeros((70, side, 3), np.uint8)
        np.savez(tmp_path / f"{side}.npz", image=image, **vars(camera))
    with pytest.raises(SystemExit, match="2 photographs"):
        read(str(tmp_path), 70)
