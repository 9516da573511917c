"""Record3D's captures, as an `.r3d` and as an exported sequence: poses, lenses, LiDAR depth."""

import json
import shutil
import sys

import numpy as np
import pytest
import torch
from complaints import complaint_about, complaint_of
from foreign_exports import HEIGHT, WIDTH, pixels_of, save_picture, shots
from scipy.spatial.transform import Rotation

from extrap_train.data.lzfse_files import read_lzfse_array
from extrap_train.data.scene_spec import open_scene

SHOTS = shots()
SIZE = HEIGHT, WIDTH


def write_metadata(folder, name="metadata", **changes):
    first = SHOTS[0]
    rotations = [Rotation.from_matrix(shot.opengl_matrix[:3, :3]).as_quat() for shot in SHOTS]
    content = {
        "K": [first.fx, 0, 0, 0, first.fy, 0, first.cx, first.cy, 1],
        **{"w": WIDTH, "h": HEIGHT, "dw": WIDTH // 2, "dh": HEIGHT // 2, "fps": 60},
        "poses": [[*q, *shot.position] for q, shot in zip(rotations, SHOTS, strict=True)],
    }
    (folder / name).write_text(json.dumps(content | changes))


@pytest.fixture
def capture(tmp_path):
    folder = tmp_path / "visit"
    for index in range(len(SHOTS)):
        save_picture(folder / f"rgbd/{index}.jpg", seed=index)
    write_metadata(folder)
    return folder


def write_maps(capture, kind=np.float32):
    lzfse = pytest.importorskip("lzfse", reason="needs lzfse: the extra `record3d`")
    for index in range(len(SHOTS)):
        depth = np.full((HEIGHT // 2, WIDTH // 2), 1.5 + index, kind)
        depth[0] = np.nan
        confidence = np.full(depth.shape, 2, np.uint8)
        confidence[1], confidence[2] = 0, 1
        for suffix, values in (("depth", depth), ("conf", confidence)):
            (capture / f"rgbd/{index}.{suffix}").write_bytes(lzfse.compress(values.tobytes()))


def test_points_are_where_the_axes_say(capture):
    sequence = open_scene(str(capture))
    assert [frame.name for frame in sequence.frames] == ["0.jpg", "1.jpg", "2.jpg"]
    for frame, shot in zip(sequence.frames, SHOTS, strict=True):
        np.testing.assert_allclose(pixels_of(frame.camera), shot.pixels(), atol=1e-3)


def test_an_archive_and_an_exported_sequence(tmp_path, capture, monkeypatch, caplog):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    shutil.move(shutil.make_archive(str(tmp_path / "a"), "zip", capture), tmp_path / "a.r3d")
    assert len(open_scene(str(tmp_path / "a.r3d")).frames) == len(SHOTS)
    (capture / "metadata").rename(capture / "metadata.json")
    (capture / "rgbd").rename(capture / "rgb")
    (capture / "depth").mkdir()
    (capture / "depth/0.exr").touch()
    assert not any(frame.has_depth for frame in open_scene(str(capture)).frames)
    assert ".r3d" in caplog.text


def test_frames_are_in_the_order_of_their_numbers(capture):
    poses = json.loads((capture / "metadata").read_text())["poses"]
    for index in range(len(SHOTS), 12):
        save_picture(capture / f"rgbd/{index}.jpg", seed=index)
    write_metadata(capture, poses=poses * 4)
    names = [frame.name for frame in open_scene(str(capture)).frames]
    assert names == [f"{index}.jpg" for index in range(12)]


def test_a_frame_has_its_own_lens(capture):
    write_metadata(capture, perFrameIntrinsicCoeffs=[[60 + i, 61, 20, 15] for i in range(3)])
    focal = [frame.camera.intrinsics[0, 0].item() for frame in open_scene(str(capture)).frames]
    assert focal == [60, 61, 62]


@pytest.mark.parametrize("kind", [np.float32, np.float16])
def test_depth_is_in_metres_and_unknown_where_confidence_is_low(capture, kind):
    write_maps(capture, kind)
    depth = open_scene(str(capture)).frames[1].load().depth
    assert depth.shape == SIZE
    assert not depth[:4].any()  # first nothing measured, then of low confidence
    assert torch.allclose(depth[4:], torch.tensor(2.5))


def test_depth_is_left_out_without_the_library(capture, monkeypatch, caplog):
    (capture / "rgbd/0.depth").touch()
    monkeypatch.setitem(sys.modules, "lzfse", None)
    assert not any(frame.has_depth for frame in open_scene(str(capture)).frames)
    assert "extrap-train[record3d]" in caplog.text


@pytest.mark.parametrize(
    "changes",
    [
        {"poses": []},
        {"poses": [[0, 0, 0, 0, 1, 2, 3]] * 3},
        {"poses": [[0, 0, 0, 1]] * 3},
        {"poses": [["x"] * 7] * 3},
        {"poses": [{}] * 3},
        {"poses": [[0, 0, 0, 1, 1e400, 0, 0]] * 3},
        {"K": [50, 0, 20, 0, 50, 15, 0, 0, 1]},
        {"K": [50, 1, 0, 0, 50, 0, 20, 15, 1]},
        {"K": [50]},
        {"K": None},
        {"w": None},
        {"w": 1e9, "h": 1e9},
        {"perFrameIntrinsicCoeffs": [[50, 50, 20, 15]]},
        {"perFrameIntrinsicCoeffs": 7},
    ],
    ids=str,
)
def test_descriptions_that_cannot_be_used(capture, changes):
    write_metadata(capture, **changes)
    assert "metadata" in complaint_of(open_scene, str(capture))


def test_missing_pictures_are_named(capture, caplog):
    (capture / "rgbd/1.jpg").unlink()
    assert [frame.name for frame in open_scene(str(capture)).frames] == ["0.jpg", "2.jpg"]
    assert "rgbd/1" in caplog.text


def test_maps_that_cannot_be_used(tmp_path):
    lzfse = pytest.importorskip("lzfse", reason="needs lzfse: the extra `record3d`")
    whole = lzfse.compress(np.ones(SIZE, np.float32).tobytes())
    other_shape = lzfse.compress(np.ones((70, 110), np.float32).tobytes())
    lying = whole[:4] + b"\xff\xff\xff\xff" + whole[8:]
    many_blocks = b"".join([b"bvx-\0\0\0\0"] * 1000) + b"bvx$" * 2
    for content in (b"", b"bvx", whole[: len(whole) // 2], other_shape, lying, many_blocks):
        (tmp_path / "a.depth").write_bytes(content)
        complaint_about(read_lzfse_array, tmp_path / "a.depth", SIZE, ("<f4", "<f2"))
