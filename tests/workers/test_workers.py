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
import torch
from posed_folders import write_transforms
from traced_scenes import SCENES, orbit_camera, render

from extrap_train import open_views, warp_view
from extrap_train.config import FilesDepthConfig
from extrap_train.errors import InputError

WORKERS = Path(__file__).parents[2] / "workers"
SCENE = SCENES["box on the ground"]
UNIT = 0.3
"""Of the stand-ins' depth, in scene units."""
CAMERAS = [orbit_camera(azimuth, 128).cropped(16, 0, 90, 128) for azimuth in (0, 12, 24)]


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
        return pixels, *(torch.from_numpy(part).float() for part in (extrinsics, intrinsics))

    def forward(self, image, extrinsics=None, intrinsics=None, export_feat_layers=None):
        assert export_feat_layers == []
        _, count, _, height, width = image.shape
        first = CAMERAS[0]
        steps = [first.world_to_cam @ camera.cam_to_world for camera in CAMERAS]
        unit = torch.stack([step[:3, 3].norm() for step in steps]).median().clamp_min(0.1)
        for index, camera in enumerate(CAMERAS):
            k = camera.resized(height, width).intrinsics
            torch.testing.assert_close(intrinsics[0, index], k, rtol=1e-4, atol=1e-3)
            step = torch.linalg.inv(extrinsics[0, index])
            torch.testing.assert_close(step[:3, :3], steps[index][:3, :3], rtol=0, atol=1e-5)
            torch.testing.assert_close(step[:3, 3] * unit, steps[index][:3, 3], rtol=0, atol=1e-5)
        depth = torch.stack([exact(i, height, width) for i in range(count)])[None]
        return {"depth": depth, "depth_conf": torch.full_like(depth, 4.0)}


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
            torch.testing.assert_close(
                view["intrinsics"][0], camera.intrinsics, rtol=1e-4, atol=1e-3
            )
            torch.testing.assert_close(view["camera_poses"][0], camera.cam_to_world)
            assert not view["is_metric_scale"].item()
            depth = exact(index, height, width)[None]
            mask = torch.ones_like(depth, dtype=torch.bool)
            mask[:, :7] = False
            conf = torch.full_like(depth, 4.0)
            predictions.append({"depth_z": depth[..., None], "conf": conf, "mask": mask[..., None]})
        return predictions


def preprocess_inputs(views, resize_mode, size):
    """That of mapanything.utils.image for pictures that have the size already."""
    assert resize_mode == "fixed_size"
    assert all(view["img"].shape == (size[1], size[0], 3) for view in views)
    return [
        view
        | {"img": view["img"].permute(2, 0, 1)[None] / 255}
        | {name: view[name][None] for name in ("intrinsics", "camera_poses")}
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
        return {"depth": depth[..., None], "depth_conf": torch.full_like(depth, 4.0)}


STAND_INS = {
    "depth_anything_3.api": {"DepthAnything3": DepthAnything3},
    "mapanything.models": {"MapAnything": MapAnything},
    "mapanything.utils.image": {"preprocess_inputs": preprocess_inputs},
    "vggt.models.vggt": {"VGGT": VGGT},
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


def test_photographs_are_chosen_by_name(scene, tmp_path, load):
    write = load("write_photographs").write_photographs
    write(str(scene), str(tmp_path), "001.png")
    assert [path.name for path in tmp_path.rglob("*.npz")] == ["001.npz"]
    with pytest.raises(InputError, match="nine"):
        write(str(scene), str(tmp_path), "nine.png")


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
