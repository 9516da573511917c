"""What is wrong with a `transforms.json` is said in one line, and costs no more than its frame."""

import logging

import numpy as np
import pytest
from captures import view_at
from complaints import complaint_of
from posed_folders import read_json, write_json, write_transforms

from extrap_train.data.transforms_json import read_cameras, read_transforms


@pytest.fixture
def folder(tmp_path):
    write_transforms(tmp_path / "capture", [view_at(azimuth) for azimuth in (0, 30, 60)])
    return tmp_path / "capture"


def _load_first(folder):
    read_transforms(folder).frames[0].load()


def test_entries_without_a_picture_are_reported(folder, caplog):
    (folder / "images" / "001.png").unlink()
    with caplog.at_level(logging.WARNING):
        sequence = read_transforms(folder)
    assert len(sequence.frames) == 2
    (record,) = caplog.records
    assert "only 2 of the 3 pictures" in record.getMessage()
    assert "images/001.png" in record.getMessage()
    assert sequence.listed == ("000.png", "001.png", "002.png")


def test_no_picture_at_all(folder):
    for picture in (folder / "images").iterdir():
        picture.unlink()
    assert "none of the 3 pictures" in complaint_of(_load_first, folder)


def test_a_link_without_its_file_says_where_it_leads(folder):
    (folder / "depth_000.png").unlink()
    (folder / "depth_000.png").symlink_to(".git/annex/objects/x")
    assert ".git/annex/objects/x" in complaint_of(_load_first, folder)


@pytest.mark.parametrize(
    "matrix",
    [
        lambda m: np.full((4, 4), np.nan),
        lambda m: np.where(np.eye(4), -np.inf, m),
        lambda m: np.zeros((4, 4)),
        lambda m: m[:2],
        lambda m: m.T,
        lambda m: m * [[1], [1], [1], [0]],
        lambda m: m @ np.diag([1, 1, -1, 1]),
        lambda m: m @ np.diag([1, 2, 1, 1]),
        lambda m: [["a"] * 4] * 4,
    ],
)
def test_a_bad_pose_costs_its_frame_alone(folder, matrix, caplog):
    content = read_json(folder)
    frame = content["frames"][1]
    bad = matrix(np.array(frame["transform_matrix"]))
    frame["transform_matrix"] = bad if isinstance(bad, list) else bad.tolist()
    write_json(folder, content)
    with caplog.at_level(logging.WARNING):
        sequence = read_transforms(folder)
    assert [frame.name for frame in sequence.frames] == ["000.png", "002.png"]
    assert len(sequence.left_out) == 1
    assert "images/001.png" in sequence.left_out[0]
    assert sequence.left_out[0] in caplog.text
    assert sequence.listed == ("000.png", "001.png", "002.png")


def test_transposed_matrices_are_named(folder):
    content = read_json(folder)
    for frame in content["frames"]:
        frame["transform_matrix"] = np.transpose(frame["transform_matrix"]).tolist()
    write_json(folder, content)
    assert "column-major" in complaint_of(_load_first, folder)


def test_poses_of_another_convention_are_named(folder):
    content = read_json(folder)
    for frame in content["frames"]:
        frame["transform_matrix"] = (
            np.array(frame["transform_matrix"]) @ np.diag([1, -1, -1, 1])
        ).tolist()
    write_json(folder, content)
    message = complaint_of(_load_first, folder)
    assert "must be camera-to-world in OpenGL's axes" in message
    assert "camera-to-world in OpenCV's axes" in message


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"file_path": "../x.png"}, "climbs out of its folder"),
        ({"file_path": "/x.png"}, "climbs out of its folder"),
        ({"file_path": 3}, "text `file_path` as frame 0"),
        ({"mask_path": "../x.png"}, "climbs out of its folder"),
        ({"transform_matrix": [[1, 2], [3, 4]]}, "has shape (2, 2)"),
        ({"transform_matrix": "none"}, "is malformed"),
        ({"transform_matrix": np.diag([0, 0, 0, 1]).tolist()}, "is degenerate"),
        ({"transform_matrix": np.zeros((4, 4)).tolist()}, "the last row of transform_matrix"),
        ({"transform_matrix": np.full((4, 4), float("nan")).tolist()}, "is degenerate"),
        ({"fl_x": 0}, "is degenerate"),
        ({"fl_x": 0, "k1": 0.1}, "is degenerate"),
        ({"fl_y": -30, "k1": 0.1}, "is degenerate"),
        ({"file_path": "n" * 256}, "has too long a name"),
        ({"file_path": "n" * 253}, "none of the 1 pictures"),
        ({"fl_x": float("nan")}, "the lens of images/000.png is not finite"),
        ({"fl_x": "wide"}, "is malformed"),
        ({"fl_x": 10**400}, "is malformed"),
        ({"transform_matrix": [[10**400] * 4] * 4}, "is malformed"),
        ({"camera_model": "FISHEYE624"}, "camera_model 'FISHEYE624' is none of"),
        ({"k1": 1e6}, "cannot be undone"),
        ({"w": 60}, "is 32 x 40 pixels"),
        ({"w": -1}, "image size 32 x -1"),
        ({"depth_file_path": "gone.png"}, "gone.png: no such file"),
    ],
)
def test_bad_entries(folder, change, expected):
    content = read_json(folder)
    write_json(folder, content | {"frames": [content["frames"][0] | change]})
    assert expected in complaint_of(_load_first, folder)


def test_missing_intrinsics_and_pose(folder):
    content = read_json(folder)
    content["frames"] = content["frames"][:1]
    for key in ("fl_x", "fl_y"):
        del content["frames"][0][key]
    write_json(folder, content)
    assert "images/000.png has 'fl_x'; add it" in complaint_of(_load_first, folder)
    del content["frames"][0]["transform_matrix"]
    content["camera_angle_x"] = 1.0
    write_json(folder, content)
    assert "images/000.png has 'transform_matrix'; add it" in complaint_of(_load_first, folder)


@pytest.mark.parametrize("content", [[], {}, {"frames": []}, {"frames": {}}, {"frames": [1]}])
def test_files_of_the_wrong_shape(folder, content):
    write_json(folder, content)
    assert "transforms.json: expected " in complaint_of(_load_first, folder)


@pytest.mark.parametrize(
    ("entry", "said"),
    [
        (lambda frame: 1, "as frame 1"),
        (lambda frame: None, "as frame 1"),
        (lambda frame: {k: v for k, v in frame.items() if k != "file_path"}, "as frame 1"),
        (lambda frame: frame | {"file_path": None}, "as frame 1"),
        (lambda frame: frame | {"file_path": ["a.png"]}, "as frame 1"),
        (lambda frame: frame | {"file_path": ""}, "path ''"),
        (lambda frame: frame | {"file_path": "../001.png"}, "../001.png"),
        (lambda frame: frame | {"mask_path": "/001.png"}, "/001.png"),
        (lambda frame: frame | {"w": None}, "images/001.png is malformed (w is null"),
        (lambda frame: frame | {"h": "32 px"}, "images/001.png is malformed (h is "),
        (lambda frame: frame | {"fl_x": None}, "images/001.png is malformed (fl_x is null"),
        (lambda frame: frame | {"depth_unit_scale_factor": []}, "depth_unit_scale_factor is []"),
    ],
)
def test_an_entry_that_makes_no_sense_costs_its_frame_alone(folder, entry, said, caplog):
    content = read_json(folder)
    content["frames"][1] = entry(content["frames"][1])
    write_json(folder, content)
    sequence = read_transforms(folder)
    assert [frame.name for frame in sequence.frames] == ["000.png", "002.png"]
    assert len(sequence.left_out) == 1
    assert said in sequence.left_out[0]
    assert f"1 of 3 frames are left out: {sequence.left_out[0]}" in caplog.text


@pytest.mark.parametrize(
    "matrix",
    [
        [["1"] * 4] * 4,
        None,
        "none",
        [1, None],
        [[1.0] * 4, [1.0] * 3],
        [[None] * 4] * 4,
        {"a": 1},
        [[10**400] * 4] * 4,
    ],
)
def test_a_matrix_that_is_none_is_one_clear_line(folder, matrix):
    content = read_json(folder)
    content["frames"][1]["transform_matrix"] = matrix
    write_json(folder, content)
    (reason,) = read_transforms(folder).left_out
    assert "images/001.png" in reason
    assert "transform_matrix is " in reason
    assert "expected 4 x 4 numbers" in reason


_SPELLINGS = ["images/001.png", "./images/./001.png", "images\\001.png", "images/001.PNG"]


@pytest.mark.parametrize("again", _SPELLINGS)
def test_equal_entries_of_a_picture_are_one_frame(folder, again, caplog):
    content = read_json(folder)
    content["frames"].append(content["frames"][1] | {"file_path": again})
    write_json(folder, content)
    sequence = read_transforms(folder)
    assert [frame.name for frame in sequence.frames] == ["000.png", "001.png", "002.png"]
    assert (sequence.left_out, sequence.listed) == ((), ("000.png", "001.png", "002.png"))
    assert "lists 1 pictures twice (images/001.png)" in caplog.text


@pytest.mark.parametrize("again", _SPELLINGS)
@pytest.mark.parametrize("other", ["pose", "fl_x", "mask_path", "depth_file_path"])
def test_entries_that_contradict_each_other_cost_their_frame_alone(folder, again, other, caplog):
    """Which of them is right is unknown."""
    content = read_json(folder)
    frames = content["frames"]
    changes = {
        "pose": {"transform_matrix": frames[0]["transform_matrix"]},
        "fl_x": {"fl_x": 90.0},
        "mask_path": {"mask_path": "mask_000.png"},
        "depth_file_path": {"depth_file_path": None},
    }
    frames.append(frames[1] | {"file_path": again} | changes[other])
    write_json(folder, content)
    sequence = read_transforms(folder)
    assert [frame.name for frame in sequence.frames] == ["000.png", "002.png"]
    assert "lists images/001.png twice" in sequence.left_out[0]
    assert sequence.left_out[0] in caplog.text


def test_a_pose_without_a_path_is_called_by_its_number(folder):
    content = read_json(folder)
    for frame, path in zip(content["frames"], ("a.png", None, None), strict=True):
        frame["file_path"] = path
    del content["frames"][2]["file_path"]
    write_json(folder, content)
    names, cameras = read_cameras(folder / "transforms.json")
    assert names == ["a.png", "001", "002"]
    assert len(cameras.world_to_cam) == 3
