"""Polycam's raw export, as its iOS app lays it out: cameras, pictures, LiDAR depth."""

import json

import numpy as np
import pytest
import torch
from complaints import complaint_of
from foreign_exports import HEIGHT, WIDTH, pixels_of, save_picture, shots
from PIL import Image

from extrap_train.data.scene_spec import open_scene

SHOTS = shots()
STEMS = [str(293814600474 + 500 * index) for index in range(len(SHOTS))]


def write_camera(folder, stem, shot, **changes):
    folder.mkdir(parents=True, exist_ok=True)
    lens = {"fx": shot.fx, "fy": shot.fy, "cx": shot.cx, "cy": shot.cy}
    matrix = {f"t_{r}{c}": shot.opengl_matrix[r, c] for r in range(3) for c in range(4)}
    size = {"width": WIDTH, "height": HEIGHT}
    content = lens | size | matrix | {"blur_score": 115.3, "timestamp": int(stem)} | changes
    (folder / f"{stem}.json").write_text(json.dumps(content))


def write_grey(path, values):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(values).save(path)


@pytest.fixture
def export(tmp_path):
    keyframes = tmp_path / "8_28_2026" / "keyframes"
    for seed, (stem, shot) in enumerate(zip(STEMS, SHOTS, strict=True)):
        write_camera(keyframes / "corrected_cameras", stem, shot)
        save_picture(keyframes / "images" / f"{stem}.jpg", seed=seed)
        millimetres = np.full((HEIGHT // 2, WIDTH // 2), 1500 + seed, np.uint16)
        confidence = np.full(millimetres.shape, 255, np.uint8)
        millimetres[0], confidence[1], confidence[2] = 0, 0, 54
        write_grey(keyframes / "depth" / f"{stem}.png", millimetres)
        write_grey(keyframes / "confidence" / f"{stem}.png", confidence)
    return keyframes.parent


def test_points_are_where_the_axes_say(export):
    sequence = open_scene(str(export))
    assert [frame.name for frame in sequence.frames] == [f"{stem}.jpg" for stem in STEMS]
    for frame, shot in zip(sequence.frames, SHOTS, strict=True):
        np.testing.assert_allclose(pixels_of(frame.camera), shot.pixels(), atol=1e-3)


def test_cameras_are_nerfstudios_but_for_its_turned_world(export):
    """nerfstudio permutes the world's axes: its rows are the file's third, first and second."""
    for frame, shot in zip(open_scene(str(export)).frames, SHOTS, strict=True):
        cam_to_world = shot.opengl_matrix[[2, 0, 1, 3]]
        points = np.random.default_rng(0).normal(size=(9, 3)) / 5
        seen = (points[:, [2, 0, 1]] - cam_to_world[:3, 3]) @ cam_to_world[:3, :3]
        pixels = seen[:, :2] / -seen[:, 2:] * [shot.fx, -shot.fy] + [shot.cx, shot.cy]
        np.testing.assert_allclose(pixels_of(frame.camera, points), pixels, atol=1e-3)


def test_depth_is_in_metres_and_unknown_where_confidence_is_low(export):
    depth = open_scene(str(export)).frames[1].load().depth
    assert depth.shape == (HEIGHT, WIDTH)
    assert not depth[:4].any()  # first nothing measured, then of low confidence
    assert torch.allclose(depth[4:], torch.tensor(1.501))


def test_depth_and_confidence_may_be_missing(export):
    (export / f"keyframes/depth/{STEMS[0]}.png").unlink()
    (export / f"keyframes/confidence/{STEMS[1]}.png").unlink()
    first, second, third = open_scene(str(export)).frames
    assert not first.has_depth
    assert second.load().depth[2:].all()
    assert third.has_depth


def test_undistorted_pictures_go_with_optimised_cameras(export):
    keyframes = export / "keyframes"
    (keyframes / "images").rename(keyframes / "corrected_images")
    for stem in STEMS:
        save_picture(keyframes / "images" / f"{stem}.jpg", seed=9)
    assert all("corrected_images" in frame.path for frame in open_scene(str(export)).frames)


def test_tracked_cameras_are_read_with_a_warning(export, caplog):
    keyframes = export / "keyframes"
    (keyframes / "corrected_cameras").rename(keyframes / "cameras")
    (keyframes / "corrected_images").mkdir()
    frames = open_scene(str(export)).frames
    assert all(frame.path.startswith("keyframes/images/") for frame in frames)
    assert "drift" in caplog.text


@pytest.mark.parametrize(
    "changes",
    [
        {"fx": float("nan")},
        {"t_03": float("inf")},
        {"t_00": "x"},
        {"width": 10**9},
        {"width": -3},
        {"fx": 0},
        {"t_00": 0, "t_10": 0, "t_20": 0},
    ],
    ids=str,
)
def test_a_bad_camera_is_left_out_by_name(export, caplog, changes):
    write_camera(export / "keyframes/corrected_cameras", STEMS[1], SHOTS[1], **changes)
    sequence = open_scene(str(export))
    assert [frame.name for frame in sequence.frames] == [f"{STEMS[0]}.jpg", f"{STEMS[2]}.jpg"]
    assert STEMS[1] in caplog.text


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"fx": 1'])
def test_files_that_are_no_cameras(export, content):
    for stem in STEMS:
        (export / f"keyframes/corrected_cameras/{stem}.json").write_text(content)
    assert ".json" in complaint_of(open_scene, str(export))


def test_missing_pictures_are_named(export, caplog):
    (export / f"keyframes/images/{STEMS[0]}.jpg").unlink()
    assert len(open_scene(str(export)).frames) == 2
    assert STEMS[0] in caplog.text
