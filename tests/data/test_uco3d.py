"""uCO3D in the layout of github.com/facebookresearch/uco3d, written here."""

import sqlite3
import struct
from contextlib import closing

import cv2
import numpy as np
import pytest
import torch
from torch.nn.functional import avg_pool2d
from traced_scenes import SCENES, orbit_camera, render

from data_prep.category_pairs import prepare_category
from extrap_train.config import FlowMatcherConfig, PrepConfig, StereoConfig, Uco3dConfig
from extrap_train.data import uco3d
from extrap_train.data.scene_spec import open_scene, scene_address
from extrap_train.errors import InputError
from extrap_train.geometry.foreign_cameras import viewpoint_from_camera
from extrap_train.views import Camera

SCENE = SCENES["box on the ground"]
AZIMUTHS_DEG = (0, 12, 24, 36)
PLACE = "fruits/apple/1-2-3"
NO_LENS = [0.0] * 12
FPS = 10


def cameras() -> list[Camera]:
    return [orbit_camera(azimuth, 96).cropped(16, 0, 64, 96) for azimuth in AZIMUTHS_DEG]


def write(root, distortion=NO_LENS, depth_scale=2.0, names=("1-2-3",)):
    """A category of sequences with the same video; one frame of it in two is annotated."""
    pictures = [_distorted(camera, distortion) for camera in cameras()]
    for name in names:
        folder = root / "fruits/apple" / name
        folder.mkdir(parents=True)
        _write_video(folder / "rgb_video.mp4", "mp4v", [p for p in pictures for _ in "ab"])
        masks = [np.full((64, 96, 3), 255, np.uint8) for _ in pictures]
        for mask in masks:
            mask[:, :10] = 0
        _write_video(folder / "mask_video.mkv", "FFV1", [m for m in masks for _ in "ab"])
    with closing(sqlite3.connect(root / uco3d.METADATA)) as made, made:
        made.execute(
            "CREATE TABLE sequence_annots (sequence_name TEXT PRIMARY KEY, category, "
            "super_category, _video_path, _mask_video_path, _depth_video_path, "
            "_reconstruction_quality_viewpoint REAL)"
        )
        made.execute(
            "CREATE TABLE frame_annots (sequence_name, frame_number, frame_timestamp REAL, "
            "_image_path, _image_size BLOB, _depth_scale_adjustment REAL, _viewpoint_R BLOB, "
            "_viewpoint_T BLOB, _viewpoint_focal_length BLOB, _viewpoint_principal_point BLOB, "
            "_viewpoint_colmap_distortion_coeffs BLOB, _viewpoint_intrinsics_format)"
        )
        for name in names:
            files = [f"fruits/apple/{name}/{f}" for f in ("rgb_video.mp4", "mask_video.mkv")]
            row = (name, "apple", "fruits", *files, f"fruits/apple/{name}/depth_maps.h5", 0.9)
            made.execute(f"INSERT INTO sequence_annots VALUES ({','.join('?' * 7)})", row)
            for number, camera in enumerate(cameras()):
                row = _frame_row(name, number, camera, distortion, depth_scale)
                made.execute(f"INSERT INTO frame_annots VALUES ({','.join('?' * 12)})", row)


def _frame_row(name, number, camera, distortion, depth_scale):
    found = viewpoint_from_camera(camera)
    parts = [found.rotation, found.translation, found.focal_length, found.principal_point]
    packed = [_pack(part.flatten().tolist()) for part in parts]
    size = struct.pack("ii", 64, 96)
    seconds = (2 * number + 0.25) / FPS
    ndc = "ndc_norm_image_bounds"  # uCO3D's reader ignores it
    return (name, number, seconds, None, size, depth_scale, *packed, _pack(distortion), ndc)


def _pack(numbers):
    return struct.pack("f" * len(numbers), *numbers)


def _write_video(path, codec, pictures):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), FPS, (96, 64))
    assert writer.isOpened()
    for picture in pictures:
        writer.write(picture[..., ::-1])
    writer.release()


def _distorted(camera, distortion):
    """What the lens shows: each of its pixels is looked up in a wider pinhole picture."""
    wide = Camera(camera.world_to_cam, camera.intrinsics.clone(), 128, 192)
    wide.intrinsics[:2, 2] += torch.tensor([48.0, 32.0])
    picture = (render(SCENE, wide).image.permute(1, 2, 0).numpy() * 255).round().astype(np.uint8)
    v, u = np.mgrid[:64, :96].astype(np.float32)
    pixels = np.stack([u, v], -1).reshape(-1, 1, 2)
    k = camera.intrinsics.double().numpy() - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    rays = cv2.undistortPoints(pixels, k, np.array(distortion)).reshape(64, 96, 2)
    at = (rays * k.diagonal()[:2] + k[:2, 2] + [48, 32]).astype(np.float32)
    return cv2.remap(picture, at[..., 0], at[..., 1], cv2.INTER_LINEAR)


def change(root, statement, *values):
    with closing(sqlite3.connect(root / uco3d.METADATA)) as opened, opened:
        opened.execute(statement, values)


def check_pictures(sequence):
    """Smoothed: the video's codec drops fine texture."""
    cameras = [frame.camera for frame in sequence.frames]
    expected = torch.stack([render(SCENE, camera).image for camera in cameras])
    for index, frame in enumerate(sequence.frames):
        view = frame.load(depth=False)
        errors = avg_pool2d(view.image - expected, 4).abs().mean((1, 2, 3))
        assert errors.argmin() == index
        assert errors[index] < 0.03
        assert view.photograph.path == f"{PLACE}/{frame.name}"
        assert view.mask[:, 20:].min() == 1


def test_frames_masks_and_cameras_of_a_sequence(tmp_path):
    write(tmp_path)
    spec = f"uco3d:{tmp_path}/{PLACE}"
    assert scene_address(spec) == spec
    sequence = open_scene(spec)
    assert (sequence.category, sequence.name) == ("apple", "1-2-3")
    assert sequence.viewpoint_quality == 0.9
    assert [frame.name for frame in sequence.frames[1:3]] == ["frame000001", "frame000002"]
    for frame, camera in zip(sequence.frames, cameras(), strict=True):
        torch.testing.assert_close(frame.camera.world_to_cam, camera.world_to_cam)
        torch.testing.assert_close(frame.camera.intrinsics, camera.intrinsics)
    check_pictures(sequence)
    assert sequence.frames[0].load(depth=False).mask[:, :8].max() == 0


def test_distortion_is_undone_as_the_depth_maps_expect(tmp_path):
    lens = [-0.15, 0.02, 0.002, -0.001, *[0.0] * 8]
    write(tmp_path, lens)
    sequence = open_scene(f"uco3d:{tmp_path}/{PLACE}")
    k = cameras()[0].intrinsics.double().numpy() - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    theirs, _ = cv2.getOptimalNewCameraMatrix(k, np.array(lens), (96, 64), 0.0, (96, 64))
    ours = sequence.frames[0].camera.intrinsics.numpy()
    np.testing.assert_allclose(ours[:2, 2] - 0.5, theirs[:2, 2], atol=1e-3)
    np.testing.assert_allclose(ours.diagonal(), theirs.diagonal(), rtol=1e-5)
    check_pictures(sequence)


def test_depth_is_found_by_the_number_after_the_frames(tmp_path):
    h5py = pytest.importorskip("h5py")
    write(tmp_path)
    file = tmp_path / PLACE / "depth_maps.h5"
    truth = [render(SCENE, camera).depth.numpy() for camera in cameras()]
    truth[2][:5] = np.inf
    with h5py.File(file, "w") as made:
        for number, depth in enumerate(truth, 1):
            made[str(number)] = depth.astype(np.float16) / 2
        made["3"][5:8] = np.nan
    sequence = uco3d.read_sequence(tmp_path, "1-2-3")
    for index in (0, 2):
        found = sequence.frames[index].load().depth.numpy()
        known = np.isfinite(truth[index]) & (found > 0)
        np.testing.assert_allclose(found[known], truth[index][known], rtol=2e-3)
    assert not found[:8].any()
    for damage in ("missing key", "link", "damaged"):
        with h5py.File(file, "w") as made:
            if damage == "link":
                made["1"] = h5py.ExternalLink("/etc/passwd", "1")
        if damage == "damaged":
            file.write_bytes(file.read_bytes()[:40])
        with pytest.raises(InputError, match=r"depth_maps\.h5"):
            sequence.frames[0].load()


def test_a_category_is_prepared_from_the_videos_that_are_there(tmp_path, caplog):
    write(tmp_path, names=("1-2-3", "4-5-6"))
    (tmp_path / "fruits/apple/4-5-6/rgb_video.mp4").unlink()
    assert uco3d.list_categories(tmp_path) == ["apple"]
    (found,) = uco3d.read_category(tmp_path, "apple")
    assert found.name == "1-2-3"
    assert "4-5-6" in caplog.text
    with pytest.raises(InputError, match="aple"):
        uco3d.read_category(tmp_path, "aple")
    with pytest.raises(InputError, match="4-5-6"):
        uco3d.read_sequence(tmp_path, "4-5-6")


@pytest.mark.parametrize(
    ("column", "value"),
    [
        ("_viewpoint_R", b"short"),
        ("_viewpoint_T", None),
        ("_viewpoint_focal_length", struct.pack("ff", float("nan"), 1)),
        ("_viewpoint_colmap_distortion_coeffs", _pack([0.0] * 11 + [0.5])),
        ("_image_size", struct.pack("ii", 2**30, 2**30)),
        ("frame_timestamp", -1.0),
        ("frame_timestamp", "soon"),
        ("_depth_scale_adjustment", "far"),
    ],
)
def test_unusable_frames_are_left_out_with_a_reason(tmp_path, column, value):
    write(tmp_path)
    change(tmp_path, f"UPDATE frame_annots SET {column} = ? WHERE frame_number = 1", value)
    sequence = uco3d.read_sequence(tmp_path, "1-2-3")
    assert len(sequence.frames) == 3
    assert "frame 1" in sequence.left_out[0]


def test_entries_of_other_types_are_no_error_of_the_program(tmp_path):
    write(tmp_path)
    change(tmp_path, "UPDATE frame_annots SET frame_number = 'two' WHERE frame_number = 2")
    change(tmp_path, "UPDATE sequence_annots SET _reconstruction_quality_viewpoint = 'good'")
    sequence = uco3d.read_sequence(tmp_path, "1-2-3")
    assert len(sequence.frames) == 3
    assert sequence.viewpoint_quality is None
    change(tmp_path, "UPDATE sequence_annots SET _video_path = 7")
    with pytest.raises(InputError, match="1-2-3"):
        uco3d.read_sequence(tmp_path, "1-2-3")


def test_bad_files_are_named(tmp_path):
    write(tmp_path)
    frame = uco3d.read_sequence(tmp_path, "1-2-3").frames[3]
    video = tmp_path / PLACE / "rgb_video.mp4"
    whole = video.read_bytes()
    for content in (b"#EXTM3U\nfile:///etc/passwd", whole[: len(whole) // 3]):
        video.write_bytes(content)
        with pytest.raises(InputError, match=r"rgb_video\.mp4"):
            frame.load(depth=False)
    video.write_bytes(whole)
    change(tmp_path, "UPDATE frame_annots SET frame_timestamp = 100 WHERE frame_number = 3")
    change(tmp_path, "UPDATE sequence_annots SET _mask_video_path = '../../secret'")
    with pytest.raises(InputError, match="secret"):
        uco3d.read_sequence(tmp_path, "1-2-3")
    (tmp_path / uco3d.METADATA).write_bytes(b"no database at all")
    with pytest.raises(InputError, match=r"metadata\.sqlite"):
        uco3d.read_sequence(tmp_path, "1-2-3")
    with pytest.raises(InputError, match=r"metadata\.sqlite"):
        open_scene(f"uco3d:{tmp_path.parent}/nothing/apple/1-2-3")


def test_pairs_are_prepared_from_videos(tmp_path):
    root, output = tmp_path / "root", tmp_path / "output"
    root.mkdir()
    write(root, names=("1-2-3", "4-5-6"))
    prepared = prepare_category(
        "apple",
        Uco3dConfig(root=str(root), test_sequences=1),
        StereoConfig(image_size=64, planes=16),
        PrepConfig(image_size=32, full_circle="ignore", correct=False),
        output=output,
        workers=1,
        matcher=FlowMatcherConfig(),
    )
    assert sorted(prepared.roles.values()) == ["test", "train"]
    assert prepared.sequences["pairs"].sum() > 0
