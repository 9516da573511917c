"""Captures of panoramas: points at known places, in transforms.json and in COLMAP's models."""

import itertools
import json

import numpy as np
import pytest
import torch
from complaints import complaint_of
from PIL import Image

from extrap_train.data.scene_spec import open_scene
from extrap_train.data.transforms_json import read_cameras
from extrap_train.errors import InputError
from extrap_train.geometry.foreign_cameras import opengl_from_world_to_cam
from extrap_train.geometry.viewpoints import looking_at

HEIGHT, WIDTH = 180, 360
POINTS = np.random.default_rng(0).uniform(-1, 1, (24, 3)) * [4, 0.8, 4]
PLACES = np.array([[0.2, 0.1, 0.0], [-0.3, 0.0, 0.4], [0.1, -0.1, -0.6]])
TARGETS = np.array([[3.0, 0.3, 1.0], [-1.0, -0.2, 3.0], [0.5, 0.4, -4.0]])
SIZE_RAD = np.radians(1.5)


def _poses():
    down = np.array([[0.05, -1, 0.02]])
    return torch.from_numpy(
        np.concatenate(
            [looking_at(p[None], t[None], down[0]) for p, t in zip(PLACES, TARGETS, strict=True)]
        )
    )


def _panorama(world_to_cam):
    """Black, with a white dot in the direction of each point."""
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    longitude, up = (u / WIDTH - 0.5) * 2 * np.pi, (0.5 - v / HEIGHT) * np.pi
    rays = [np.cos(up) * np.sin(longitude), -np.sin(up), np.cos(up) * np.cos(longitude)]
    seen = POINTS @ world_to_cam[:3, :3].numpy().T + world_to_cam[:3, 3].numpy()
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    angles = np.arccos(np.clip(np.stack(rays, -1) @ seen.T, -1, 1)).min(-1)
    return np.round(255 * np.exp(-((angles / SIZE_RAD) ** 2))).astype(np.uint8)


def _write(folder, **keys):
    (folder / "images").mkdir(parents=True)
    frames = []
    for number, pose in enumerate(_poses()):
        dots = Image.fromarray(_panorama(pose))
        dots.convert("RGB").save(folder / "images" / f"{number}.png")
        matrix = opengl_from_world_to_cam(pose).tolist()
        frames.append({"file_path": f"images/{number}.png", "transform_matrix": matrix})
    content = {"camera_model": "EQUIRECTANGULAR", "frames": frames, **keys}
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def _write_colmap(folder):
    pycolmap = pytest.importorskip("pycolmap", reason="needs pycolmap: the extra `poses`")
    (_write(folder) / "transforms.json").unlink()
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(
            camera_id=1, model="EQUIRECTANGULAR", width=WIDTH, height=HEIGHT, params=[WIDTH, HEIGHT]
        )
    )
    for number, pose in enumerate(_poses().numpy()):
        image = pycolmap.Image(image_id=number + 1, name=f"{number}.png", camera_id=1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose[:3]))
    (folder / "sparse" / "0").mkdir(parents=True)
    model.write(folder / "sparse" / "0")
    return folder


def _require_points_at_their_places(frames):
    """Around each projected point the picture is brightest there, to a fraction of a pixel."""
    count = 0
    for view in (frame.load() for frame in frames):
        camera, image = view.camera, view.image[0].numpy()
        seen = POINTS @ camera.world_to_cam[:3, :3].numpy().T + camera.world_to_cam[:3, 3].numpy()
        pixels = seen @ camera.intrinsics.numpy().T
        pixels = pixels[pixels[:, 2] > 0.2]
        pixels = pixels[:, :2] / pixels[:, 2:]
        apart = np.linalg.norm(pixels[:, None] - pixels, axis=-1) + 1e3 * np.eye(len(pixels))
        inside = ((pixels > 8) & (pixels < camera.width - 8)).all(1)
        for u, v in pixels[inside & (apart.min(1) > 14)]:
            rows, columns = np.mgrid[int(v) - 6 : int(v) + 7, int(u) - 6 : int(u) + 7]
            weight = image[rows, columns]
            assert weight.max() > 0.7
            centroid = [(weight * (axis + 0.5)).sum() / weight.sum() for axis in (columns, rows)]
            assert np.abs(np.array(centroid) - [u, v]).max() < 0.5
            count += 1
    assert count > 25


def test_points_are_where_the_composed_cameras_say(tmp_path):
    frames = open_scene(str(_write(tmp_path))).frames
    yaws = (0, 60, 120, 180, 240, 300)
    assert [f.name for f in frames] == [
        f"{number}@{yaw:03d}.png" for number, yaw in itertools.product(range(3), yaws)
    ]
    assert {frame.path for frame in frames} == {f"images/{frame.name}" for frame in frames}
    _require_points_at_their_places(frames)


def test_colmaps_panoramas(tmp_path):
    _require_points_at_their_places(open_scene(str(_write_colmap(tmp_path))).frames)


def test_masks_are_cut_with_the_panoramas(tmp_path):
    (_write(tmp_path) / "masks").mkdir()
    for number in range(3):
        picture = Image.open(tmp_path / "images" / f"{number}.png").convert("L")
        picture.point(lambda value: 255 * (value > 20)).save(tmp_path / "masks" / f"{number}.png")
    for frame in open_scene(str(tmp_path)).frames:
        view = frame.load()
        assert view.mask.shape == view.image.shape[1:]
        assert (view.image[0][view.mask < 0.01] < 0.15).all()
        assert (view.image[0][view.mask > 0.99] > 0.05).all()


def test_another_size_of_the_same_panorama(tmp_path):
    frames = open_scene(str(_write(tmp_path, w=2 * WIDTH, h=2 * HEIGHT))).frames
    _require_points_at_their_places(frames)


def test_a_panorama_among_pictures_of_other_lenses(tmp_path):
    """A frame's own camera model; names of what is not cut stay."""
    content = json.loads((_write(tmp_path) / "transforms.json").read_text())
    content["frames"][1] |= {"camera_model": "OPENCV", "fl_x": 200, "k1": -0.05}
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    names = [frame.name for frame in open_scene(str(tmp_path)).frames]
    assert len(names) == 13
    assert "1.png" in names


def _change(folder, change):
    content = json.loads((folder / "transforms.json").read_text())
    change(content)
    (folder / "transforms.json").write_text(json.dumps(content))
    return complaint_of(open_scene, str(folder))


def _one_place(content):
    for frame in content["frames"]:
        frame["transform_matrix"] = content["frames"][0]["transform_matrix"]


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda content: content.update(w=WIDTH, h=WIDTH), "twice as wide"),
        (lambda content: content.update(fl_x=10), "fl_x"),
        (lambda content: content.update(k1=0.1), "k1"),
        (lambda content: content.update(depth_file_path="images/0.png"), "depth"),
        (_one_place, "one place"),
    ],
)
def test_what_is_no_capture_of_panoramas(tmp_path, change, named):
    assert named in _change(_write(tmp_path), change)


def test_a_frame_called_like_a_cut(tmp_path):
    (_write(tmp_path) / "images" / "2.png").rename(tmp_path / "images" / "0@060.png")

    def change(content):
        content["frames"][2] |= {"file_path": "images/0@060.png", "camera_model": "PINHOLE"}
        content["frames"][2]["fl_x"] = 200

    assert "0@060.png" in _change(tmp_path, change)


def test_views_are_asked_for_with_perspective_cameras(tmp_path):
    file = _write(tmp_path, w=WIDTH, h=HEIGHT) / "transforms.json"
    with pytest.raises(InputError, match="perspective"):
        read_cameras(file)
