import pickle

import numpy as np
import pytest
import torch
from captures import frame_entries, replace_frame_entries, view_at, write_capture
from PIL import Image
from plyfile import PlyData

from extrap_train.data import co3d
from extrap_train.data.co3d import list_categories, read_category, read_sequence
from extrap_train.geometry.cameras import project


@pytest.fixture
def root(tmp_path):
    write_capture(tmp_path)
    return tmp_path


def test_what_is_written_is_read_again(root):
    sequences = read_category(root, "cup")
    assert [sequence.name for sequence in sequences] == ["one", "two"]
    assert [frame.name for frame in sequences[0].frames] == [
        "frame000001.jpg",
        "frame000011.jpg",
        "frame000021.jpg",
    ]
    for index, frame in enumerate(sequences[0].frames):
        truth, read = view_at(30 * index), frame.load()
        points = torch.randn(100, 3).double()
        for camera in (frame.camera, read.camera):
            torch.testing.assert_close(camera.world_to_cam, truth.camera.world_to_cam)
            pixels, _ = project(points.float(), camera)
            expected, _ = project(points.float(), truth.camera)
            assert (pixels - expected).abs().max() < 1e-5
        torch.testing.assert_close(read.depth, truth.depth, rtol=2**-11, atol=0)
        torch.testing.assert_close(read.mask, truth.mask)
        assert (read.image - truth.image).abs().mean() < 0.01


def test_the_point_cloud_and_the_quality_are_found(root):
    sequence = read_sequence(root, "cup", "two")
    assert sequence.viewpoint_quality == 1
    assert sequence.point_cloud_quality == 1
    vertices = PlyData.read(sequence.point_cloud.find())["vertex"]
    assert vertices.count == 20
    assert {"x", "y", "z", "red", "green", "blue"} <= set(vertices.data.dtype.names)


def test_a_point_cloud_may_lie_on_another_disk(root, tmp_path_factory):
    cloud = root / "cup" / "two" / "pointcloud.ply"
    outside = cloud.rename(tmp_path_factory.mktemp("outside") / "cloud.ply")
    assert read_sequence(root, "cup", "two").point_cloud.find() is None
    cloud.symlink_to(outside)
    assert read_sequence(root, "cup", "two").point_cloud.find().samefile(outside)


def test_categories_and_sequences_may_lie_on_other_disks(root, tmp_path_factory):
    expected = read_sequence(root, "cup", "two").frames[0].load()
    disk = tmp_path_factory.mktemp("disk")
    for folder in (root / "cup" / "two", root / "cup" / "one" / "images", root / "cup"):
        moved = folder.rename(disk / f"moved {folder.name}")
        folder.symlink_to(moved)
    found = read_sequence(root, "cup", "two").frames[0].load()
    assert torch.equal(found.image, expected.image)
    assert torch.equal(found.depth, expected.depth)
    assert len(read_sequence(root, "cup", "one").frames[0].load().image) == 3


def test_the_same_views_give_the_same_bytes(tmp_path):
    for name in ("a", "b"):
        torch.manual_seed(0)
        write_capture(tmp_path / name, frames=2)
    first = sorted(path for path in (tmp_path / "a").rglob("*") if path.is_file())
    assert len(first) == 2 * 2 * 4 + 2 + 3
    for path in first:
        twin = tmp_path / "b" / path.relative_to(tmp_path / "a")
        assert path.read_bytes() == twin.read_bytes()


def test_categories_are_the_folders_with_annotations(root):
    (root / "not_a_category").mkdir()
    assert list_categories(root) == ["cup"]


def test_depth_mask_and_point_cloud_may_be_absent(root):
    entries = frame_entries(root)
    for entry in entries:
        entry["depth"] = entry["mask"] = None
    entries[0]["viewpoint"] = None
    replace_frame_entries(root, entries)
    sequence = read_category(root, "cup")[0]
    assert len(sequence.frames) == 2
    frame = sequence.frames[0]
    assert not frame.has_depth
    assert not frame.has_mask
    view = frame.load()
    assert view.depth is None
    assert view.mask is None


def test_the_first_release_normalises_by_both_sides(root):
    entries = frame_entries(root)
    for entry in entries:
        del entry["viewpoint"]["intrinsics_format"]
        entry["viewpoint"]["focal_length"] = [2.0, 3.0]
        entry["viewpoint"]["principal_point"] = [0.5, 0.25]
    replace_frame_entries(root, entries)
    k = read_category(root, "cup")[0].frames[0].camera.intrinsics
    # The images are 32 high and 40 wide.
    assert k.tolist() == [[40, 0, 10], [0, 48, 12], [0, 0, 1]]


def test_depth_is_scaled_and_what_is_no_depth_is_unknown(root):
    entry = frame_entries(root)[0]
    raw = np.full((32, 40), 2.0, np.float16)
    raw[0, :4] = [np.inf, np.nan, -1, 0]
    Image.fromarray(raw.view(np.uint16)).save(root / entry["depth"]["path"])
    trusted = np.ones((32, 40), bool)
    trusted[5, 5] = False
    Image.fromarray(trusted).save(root / entry["depth"]["mask_path"])
    entry["depth"]["scale_adjustment"] = 1.5
    replace_frame_entries(root, [entry])
    depth = read_category(root, "cup")[0].frames[0].load().depth
    assert depth[0, :5].tolist() == [0, 0, 0, 0, 3]
    assert depth[5, 4:7].tolist() == [3, 0, 3]


def test_frames_can_be_sent_to_worker_processes(root):
    frames = read_category(root, "cup")[0].frames
    frame = pickle.loads(pickle.dumps(frames))[0]
    again = pickle.loads(pickle.dumps(frame)).load()
    torch.testing.assert_close(again.image, frame.load().image)


def test_entries_need_not_stand_together(root, monkeypatch):
    monkeypatch.setattr(co3d, "_ENTRIES_AT_A_TIME", 4)
    expected = read_category(root, "cup")
    entries = frame_entries(root)
    replace_frame_entries(root, [*entries[::2], *entries[1::2]])
    for one, other in zip(read_category(root, "cup"), expected, strict=True):
        assert one.name == other.name
        assert [frame.name for frame in one.frames] == [frame.name for frame in other.frames]
        for first, second in zip(one.frames, other.frames, strict=True):
            assert torch.equal(first.camera.world_to_cam, second.camera.world_to_cam)
            assert torch.equal(first.load().depth, second.load().depth)


def test_frames_are_a_sequence_from_both_ends(root):
    frames = read_category(root, "cup")[0].frames
    names = [frame.name for frame in frames]
    assert len(frames) == 3
    assert frames[-1].name == names[2]
    assert [frame.name for frame in frames[1:]] == names[1:]
    assert [frame.name for frame in reversed(frames)] == names[::-1]
    with pytest.raises(IndexError):
        frames[3]


def test_frames_of_different_sizes_keep_their_own_camera(root):
    entries = frame_entries(root)
    entries[1]["image"]["size"] = [64, 80]
    replace_frame_entries(root, entries)
    frames = read_category(root, "cup")[0].frames
    assert [frame.camera.height for frame in frames] == [32, 64, 32]
    torch.testing.assert_close(
        frames[1].camera.intrinsics[0, 0], 2 * frames[0].camera.intrinsics[0, 0]
    )
