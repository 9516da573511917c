"""Captures by several cameras, with pycolmap as the oracle: rigs, and a lens for each frame."""

import json

import numpy as np
import pytest
import torch
from PIL import Image
from scenes import orbit_camera

from extrap_train.data.lens_keys import merge_entry
from extrap_train.data.scene_spec import open_scene
from extrap_train.geometry.foreign_cameras import opengl_from_world_to_cam

pycolmap = pytest.importorskip("pycolmap", reason="needs pycolmap: the extra `poses`")

WIDTH, HEIGHT = 160, 120
POINT = np.array([0.1, -0.05, 0.1])
COMMON = {"fl_x": 150.0, "fl_y": 152.0, "cx": 81.0, "cy": 58.0}
LENSES = [
    {"camera_model": "OPENCV", "k1": -0.1, "k2": 0.02, "p1": 0.001, "p2": -0.002},
    {"camera_model": "OPENCV_FISHEYE", "k1": 0.02, "k2": -0.01, "k3": 0.0, "k4": 0.0},
    {"camera_model": "PINHOLE"},
    {"camera_model": "FULL_OPENCV", "k1": 0.05, "k2": 0, "p1": 0, "p2": 0, "k3": 0}
    | {"k4": 0.1, "k5": 0.01, "k6": 0},
    {"camera_model": "OPENCV", "fl_x": 120.0, "fl_y": 120.0, "k1": 0.1, "k2": 0, "p1": 0, "p2": 0},
]


def _save_dot(path, pixel):
    """A bright dot around (u, v)."""
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    dot = 255 * np.exp(-((u - pixel[0]) ** 2 + (v - pixel[1]) ** 2) / 8)
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(dot.round().astype(np.uint8)).convert("RGB").save(path)


def _require_dots_at_their_places(frames):
    for view in (frame.load() for frame in frames):
        camera, weight = view.camera, view.image[0].double() / view.image[0].sum()
        u, v, w = (
            camera.intrinsics.double()
            @ (camera.world_to_cam.double() @ torch.tensor([*POINT, 1.0]))[:3]
        )
        columns, rows = torch.arange(WIDTH) + 0.5, torch.arange(HEIGHT) + 0.5
        centroid = torch.stack([(weight.sum(0) * columns).sum(), (weight.sum(1) * rows).sum()])
        assert (centroid - torch.stack([u / w, v / w])).abs().max() < 0.1, view.name


def _colmap_camera(keys, number=1):
    named = COMMON | keys
    order = pycolmap.Camera(model=keys["camera_model"]).params_info.replace(" ", "").split(",")
    spelt = {"fx": "fl_x", "fy": "fl_y"}
    return pycolmap.Camera(
        camera_id=number,
        model=keys["camera_model"],
        width=WIDTH,
        height=HEIGHT,
        params=[named[spelt.get(key, key)] for key in order],
    )


def _pose(azimuth_deg):
    return orbit_camera(azimuth_deg, size=WIDTH).world_to_cam.double().numpy()


def _seen_by(camera, world_to_cam):
    return camera.img_from_cam(world_to_cam[:3, :3] @ POINT + world_to_cam[:3, 3])


@pytest.mark.parametrize("first_for_all", [False, True])
def test_a_lens_for_each_frame(tmp_path, first_for_all):
    """With the first lens for all, the others must not take its distortion."""
    frames = []
    for number, keys in enumerate(LENSES):
        pose = _pose(20 * number)
        _save_dot(tmp_path / f"{number}.png", _seen_by(_colmap_camera(keys), pose))
        matrix = opengl_from_world_to_cam(torch.from_numpy(pose)).tolist()
        own = {} if first_for_all and number == 0 else keys
        frames.append({"file_path": f"{number}.png", "transform_matrix": matrix, **own})
    common = COMMON | (LENSES[0] if first_for_all else {})
    (tmp_path / "transforms.json").write_text(json.dumps(common | {"frames": frames}))
    sequence = open_scene(str(tmp_path))
    assert len(sequence.frames) == len(LENSES)
    _require_dots_at_their_places(sequence.frames)


@pytest.mark.parametrize("kind", ["bin", "txt"])
def test_rigs(tmp_path, kind):
    """Poses are those of frame and sensor together, as pycolmap composes them."""
    model, sensors = pycolmap.Reconstruction(), []
    for number, keys in ((3, LENSES[2]), (5, LENSES[1])):
        model.add_camera(_colmap_camera(keys, number))
        sensors.append(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, number))
    rig = pycolmap.Rig(rig_id=2)
    rig.add_ref_sensor(sensors[0])
    turn = pycolmap.Rotation3d(np.array([0.02, -0.1, 0.05]))
    rig.add_sensor(sensors[1], pycolmap.Rigid3d(turn, np.array([-0.2, 0.03, 0.05])))
    model.add_rig(rig)
    for number in range(1, 5):
        frame = pycolmap.Frame(frame_id=number, rig_id=2)
        frame.rig_from_world = pycolmap.Rigid3d(_pose(20 * number)[:3])
        names = {2 * number: f"left/{number}.png", 2 * number + 1: f"right/{number}.png"}
        for image_id, sensor in zip(names, sensors, strict=True):
            frame.add_data_id(pycolmap.data_t(sensor, image_id))
        model.add_frame(frame)
        for (image_id, name), sensor in zip(names.items(), sensors, strict=True):
            image = pycolmap.Image(image_id=image_id, name=name, camera_id=sensor.id)
            image.frame_id = number
            model.add_image(image)
        model.register_frame(number)
    folder = tmp_path / "sparse" / "0"
    folder.mkdir(parents=True)
    model.write_binary(folder) if kind == "bin" else model.write_text(folder)
    assert (folder / f"rigs.{kind}").is_file()
    poses = {}
    for image in model.images.values():
        pose = np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])
        poses[image.name.replace("/", "_")] = pose
        _save_dot(tmp_path / "images" / image.name, _seen_by(model.cameras[image.camera_id], pose))
    frames = open_scene(str(tmp_path)).frames
    assert [frame.name for frame in frames] == sorted(poses)
    for frame in frames:
        expected = torch.from_numpy(poses[frame.name])
        torch.testing.assert_close(frame.camera.world_to_cam.double(), expected, atol=1e-6, rtol=0)
    _require_dots_at_their_places(frames)


@pytest.mark.parametrize(
    ("common", "frame", "kept"),
    [
        ({"camera_model": "OPENCV", "k1": 1}, {"camera_model": "OPENCV"}, {"k1"}),
        ({"k1": 1}, {"camera_model": "OPENCV"}, {"k1"}),
        ({"is_fisheye": False, "k1": 1}, {"camera_model": "OPENCV"}, {"k1"}),
        ({"is_fisheye": True, "k1": 1, "fl_x": 2}, {"camera_model": "OPENCV"}, {"fl_x"}),
        ({"distortion_params": [1], "camera_model": "OPENCV"}, {"is_fisheye": True}, set()),
        ({"camera_model": "EQUIRECTANGULAR", "fl_x": 2}, {"camera_model": "PINHOLE"}, set()),
        ({"camera_model": "OPENCV", "skew": 2}, {"camera_model": "EQUIRECTANGULAR"}, {"skew"}),
    ],
)
def test_what_a_frame_with_its_own_model_takes_over(common, frame, kept):
    assert merge_entry(common, frame).keys() - {"camera_model", "is_fisheye"} == kept
