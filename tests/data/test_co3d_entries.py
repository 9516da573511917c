"""An entry of CO3D's annotations that makes no sense costs its frame and nothing else."""

import gzip
import json

import numpy as np
import pytest
from captures import frame_entries, replace_frame_entries, write_capture
from complaints import complaint_of
from PIL import Image

from extrap_train.data.co3d import read_category, read_sequence

ANNOTATIONS = "frame_annotations.jgz"


@pytest.fixture
def root(tmp_path):
    write_capture(tmp_path, names=("one",), frames=1)
    return tmp_path


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"image": None}, "entry 0 is malformed"),
        ({"image": {"path": "x.jpg"}}, "entry 0 has no 'size'"),
        ({"image": {"path": "x.jpg", "size": [32]}}, "entry 0 is malformed"),
        ({"image": {"path": "x.jpg", "size": [0, 40]}}, "image size 0 x 40"),
        ({"image": {"path": "x.jpg", "size": [10**400, 40]}}, "entry 0 is malformed"),
        ({"image": {"path": "x.jpg", "size": ["32", "40"]}}, "image size is '32'"),
        ({"image": {"path": 7, "size": [32, 40]}}, "path is 7"),
        ({"sequence_name": 5}, "sequence_name is 5"),
        ({"frame_number": "1"}, "frame_number is '1'"),
        ({"frame_number": 2**63}, "entry 0 is malformed"),
        ({"depth": {"path": "x.png"}}, "entry 0 has no 'scale_adjustment'"),
        ({"depth": ["x.png"]}, "entry 0 is malformed"),
        ({"depth": {"path": "x.png", "scale_adjustment": 10**400}}, "entry 0 is malformed"),
        ({"viewpoint": [1]}, "entry 0 is malformed"),
    ],
)
def test_annotations_of_the_wrong_shape(root, change, expected):
    replace_frame_entries(root, [frame_entries(root)[0] | change])
    message = complaint_of(read_category, root, "cup")
    assert ANNOTATIONS in message
    assert expected in message


@pytest.mark.parametrize("entry", [None, 3, [], "text"])
def test_entries_that_are_no_objects(root, entry):
    replace_frame_entries(root, [entry])
    assert "entry 0 is malformed" in complaint_of(read_category, root, "cup")


@pytest.mark.parametrize(
    "path",
    ["../x.jpg", "cup/../../x.jpg", "/etc/passwd", "C:\\x.jpg", "a\\..\\..\\x.jpg", "", "\0"],
)
@pytest.mark.parametrize("kind", ["image", "depth", "mask"])
def test_paths_that_leave_the_root(root, kind, path):
    entry = frame_entries(root)[0]
    entry[kind]["path"] = path
    replace_frame_entries(root, [entry])
    if path or kind == "image":
        assert "climbs out of its folder" in complaint_of(read_category, root, "cup")


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"R": [[float("nan")] * 3] * 3}, "camera of one frame 1 is degenerate"),
        ({"R": np.zeros((3, 3)).tolist()}, "is degenerate"),
        ({"R": (2 * np.eye(3)).tolist()}, "is degenerate"),
        ({"R": np.diag([1.0, 1, -1]).tolist()}, "is degenerate"),
        ({"T": [0, float("inf"), 0]}, "is degenerate"),
        ({"T": [0, 1e300, 0]}, "is degenerate"),
        ({"T": [0, 10**400, 0]}, "has no T of 3 numbers"),
        ({"focal_length": [0, 1]}, "is degenerate"),
        ({"focal_length": [-1, -1]}, "is degenerate"),
        ({"R": [1, 2, 3]}, "has no R of 3 x 3 numbers"),
        ({"T": None}, "has no T of 3 numbers"),
        ({"T": ["a", "b", "c"]}, "has no T of 3 numbers"),
        ({"principal_point": [0]}, "has no principal_point of 2 numbers"),
        ({"intrinsics_format": "pixels"}, "intrinsics_format 'pixels' is none of ndc_isotropic"),
    ],
)
def test_degenerate_cameras(root, change, expected):
    entry = frame_entries(root)[0]
    entry["viewpoint"] |= change
    replace_frame_entries(root, [entry])
    message = complaint_of(read_category, root, "cup")
    assert ANNOTATIONS in message
    assert expected in message


def test_a_degenerate_camera_costs_its_frame_alone(tmp_path, caplog):
    write_capture(tmp_path, names=("one", "two"), frames=3)
    entries = frame_entries(tmp_path)
    for entry in entries:
        if entry["sequence_name"] == "one" and entry["frame_number"] != 11:
            entry["viewpoint"]["R"][0][0] = float("nan")
    replace_frame_entries(tmp_path, entries)
    one, two = read_category(tmp_path, "cup")
    assert [frame.name for frame in one.frames] == ["frame000011.jpg"]
    assert len(one.left_out) == 2
    assert all(f"{ANNOTATIONS}: the camera of one frame " in reason for reason in one.left_out)
    assert [len(two.frames), two.left_out] == [3, ()]
    assert "2 frames are left out, the first: " in caplog.text
    assert one.frames[0].load().name == "frame000011.jpg"


def test_a_sequence_without_a_sound_camera_is_empty_and_no_scene(tmp_path):
    write_capture(tmp_path, names=("one", "two"), frames=2)
    entries = frame_entries(tmp_path)
    for entry in entries:
        if entry["sequence_name"] == "one":
            entry["viewpoint"]["focal_length"] = [0, 0]
    replace_frame_entries(tmp_path, entries)
    one, two = read_category(tmp_path, "cup")
    assert [len(one.frames), len(one.left_out), len(two.frames)] == [0, 2, 2]
    message = complaint_of(read_sequence, tmp_path, "cup", "one")
    assert "one: none of its frames can be used: " in message


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("focal_length", [1e30, 1]),
        ("focal_length", [1, 1e-9]),
        ("focal_length", [True, 1]),
        ("principal_point", [1e6, 0]),
        ("principal_point", [0, -1e6]),
        ("R", [[True, 0, 0], [0, 1, 0], [0, 0, 1]]),
        ("T", [False, 0, 3]),
    ],
)
def test_nonsense_costs_its_frame_alone(tmp_path, key, value):
    write_capture(tmp_path, names=("one",), frames=4)
    entries = frame_entries(tmp_path)
    entries[1]["viewpoint"][key] = value
    replace_frame_entries(tmp_path, entries)
    (sequence,) = read_category(tmp_path, "cup")
    assert (len(sequence.frames), len(sequence.left_out)) == (3, 1)
    assert "degenerate" in sequence.left_out[0]


def _viewpoint_of_junk(entry):
    return entry | {"viewpoint": entry["viewpoint"] | {"junk": ["[]"] * 20_000}}


@pytest.mark.parametrize(
    "grow",
    [
        lambda entry: entry | {"meta": [[]] * 30_000},
        lambda entry: entry | {"sequence_name": "n" * 70_000},
        _viewpoint_of_junk,
    ],
)
def test_an_entry_without_measure_is_refused(root, grow):
    (entry,) = frame_entries(root)
    replace_frame_entries(root, [entry, grow(entry)])
    assert "has an entry of more than" in complaint_of(read_category, root, "cup")


def _as_challenge(root, kind):
    """Every third frame a hidden target, black as CO3D has them."""
    entries = frame_entries(root)
    for entry in entries:
        hidden = entry["frame_number"] % 30 == 21
        entry["meta"] = {"frame_type": kind if hidden else "train_known"}
        if hidden:
            for part in ("image", "mask", "depth"):
                file = root / entry[part]["path"]
                picture = Image.open(file)
                Image.new(picture.mode, picture.size).save(file)
    replace_frame_entries(root, entries)


@pytest.mark.parametrize("kind", ["test_unseen", "dev_unseen", "train_unseen"])
def test_black_targets_of_the_challenge_are_left_out_as_known(tmp_path, kind):
    write_capture(tmp_path, names=("one", "two"), frames=9)
    _as_challenge(tmp_path, kind)
    for sequence in read_category(tmp_path, "cup"):
        assert (len(sequence.frames), sequence.left_out) == (6, ())
        for frame in sequence.frames:
            frame.load()


def test_targets_whose_picture_was_withheld_are_left_out_as_known(tmp_path):
    write_capture(tmp_path, names=("one",), frames=9)
    _as_challenge(tmp_path, "test_unseen")
    for entry in frame_entries(tmp_path):
        if entry["meta"]["frame_type"] == "test_unseen":
            (tmp_path / entry["image"]["path"]).unlink()
    (sequence,) = read_category(tmp_path, "cup")
    assert (len(sequence.frames), sequence.left_out) == (6, ())


def test_unseen_frames_with_a_picture_are_frames(tmp_path):
    """In the first release, and in the development sets of the second, they are photographs."""
    write_capture(tmp_path, names=("one",), frames=3, size=96)
    entries = frame_entries(tmp_path)
    replace_frame_entries(tmp_path, [e | {"meta": {"frame_type": "dev_unseen"}} for e in entries])
    (sequence,) = read_category(tmp_path, "cup")
    assert len(sequence.frames) == 3


@pytest.mark.parametrize("meta", [None, [], "test_unseen", {"frame_type": None}, {"x": 1}])
def test_other_notes_on_a_frame_mean_nothing(root, meta):
    replace_frame_entries(root, [frame_entries(root)[0] | {"meta": meta}])
    assert len(read_category(root, "cup")[0].frames) == 1


def _without(*keys):
    return lambda entry: {key: value for key, value in entry.items() if key not in keys}


@pytest.mark.parametrize(
    "change",
    [
        lambda entry: None,
        lambda entry: [entry],
        lambda entry: entry | {"image": None},
        lambda entry: entry | {"image": entry["image"] | {"path": None}},
        lambda entry: entry | {"image": {"size": [32, 40]}},
        lambda entry: entry | {"image": entry["image"] | {"path": "../x.jpg"}},
        lambda entry: entry | {"image": entry["image"] | {"size": None}},
        lambda entry: entry | {"sequence_name": None},
        lambda entry: entry | {"sequence_name": "s\ud800"},
        lambda entry: entry | {"frame_number": None},
        lambda entry: entry | {"viewpoint": entry["viewpoint"] | {"T": None}},
        lambda entry: entry | {"mask": {"path": "/etc/passwd"}},
        _without("image"),
        _without("sequence_name"),
        _without("frame_number"),
    ],
)
def test_an_entry_that_cannot_be_read_costs_its_frame_alone(tmp_path, change, caplog):
    write_capture(tmp_path, names=("one", "two"), frames=3)
    entries = frame_entries(tmp_path)
    entries[1] = change(entries[1])
    replace_frame_entries(tmp_path, entries)
    one, two = read_category(tmp_path, "cup")
    assert [len(one.frames), len(two.frames)] == [2, 3]
    assert "1 frames are left out, the first: " in caplog.text
    assert ANNOTATIONS in caplog.text
    assert all(reason in caplog.text for reason in one.left_out)


def test_a_sequence_of_which_no_entry_can_be_read_says_so(tmp_path):
    write_capture(tmp_path, names=("one", "two"), frames=2)
    entries = [
        entry | {"image": None} if entry["sequence_name"] == "one" else entry
        for entry in frame_entries(tmp_path)
    ]
    replace_frame_entries(tmp_path, entries)
    assert [len(sequence.frames) for sequence in read_category(tmp_path, "cup")] == [0, 2]
    assert "entry 0 is malformed" in complaint_of(read_sequence, tmp_path, "cup", "one")


_SPELLINGS = [("/", "/"), ("/", "/./"), ("/", "//"), ("images/", "images/././")]


def _listed_again(entry, spelling, **changes):
    again = json.loads(json.dumps(entry)) | {"frame_number": 99} | changes
    again["image"]["path"] = entry["image"]["path"].replace(*spelling, 1)
    return again


@pytest.mark.parametrize("spelling", _SPELLINGS)
def test_equal_entries_of_an_image_are_one_frame(tmp_path, spelling, caplog):
    write_capture(tmp_path, names=("one", "two"), frames=3)
    entries = frame_entries(tmp_path)
    replace_frame_entries(tmp_path, [*entries, _listed_again(entries[1], spelling)])
    one, two = read_category(tmp_path, "cup")
    names = [f"frame{number:06d}.jpg" for number in (1, 11, 21)]
    assert [frame.name for frame in one.frames] == names
    assert [frame.name for frame in two.frames] == names
    assert one.left_out == ()
    assert "1 entries of one list an image again" in caplog.text


@pytest.mark.parametrize("spelling", _SPELLINGS)
@pytest.mark.parametrize("key", ["viewpoint", "depth", "mask"])
def test_entries_that_contradict_each_other_cost_their_frame_alone(tmp_path, spelling, key, caplog):
    write_capture(tmp_path, names=("one", "two"), frames=3)
    entries = frame_entries(tmp_path)
    again = _listed_again(entries[1], spelling, **{key: entries[0][key]})
    replace_frame_entries(tmp_path, [*entries, again])
    one, two = read_category(tmp_path, "cup")
    assert [frame.name for frame in one.frames] == ["frame000001.jpg", "frame000021.jpg"]
    assert len(two.frames) == 3
    (reason,) = one.left_out
    assert "cup/one/images/frame000011.jpg twice" in reason
    assert reason in caplog.text


@pytest.mark.parametrize("change", [{"sequence_name": "s\udcff"}, {"point_cloud": [1]}, None])
def test_a_description_that_cannot_be_read_costs_no_frame(tmp_path, change, caplog):
    write_capture(tmp_path, names=("one", "two"), frames=2)
    file = tmp_path / "cup" / "sequence_annotations.jgz"
    entries = json.loads(gzip.decompress(file.read_bytes()))
    entries[0] = entries[0] | change if change else change
    file.write_bytes(gzip.compress(json.dumps(entries).encode()))
    one, two = read_category(tmp_path, "cup")
    assert (one.point_cloud, two.viewpoint_quality) == (None, 1.0)
    assert "sequence_annotations.jgz: entry 0 is malformed" in caplog.text


@pytest.mark.parametrize("letter", [0xD800, 0xDCFF])
@pytest.mark.parametrize("file", ["frame_annotations.jgz", "sequence_annotations.jgz"])
def test_a_lone_name_that_is_no_unicode(root, file, letter):
    path = root / "cup" / file
    entries = json.loads(gzip.decompress(path.read_bytes()))
    entries[0]["sequence_name"] = f"s5{chr(letter)}"
    path.write_bytes(gzip.compress(json.dumps(entries).encode()))
    message = complaint_of(read_category, root, "cup")
    assert f"{file}: entry 0 is malformed (sequence_name 's5\\u{letter:x}' is no" in message


def test_a_frame_that_is_a_crop_of_its_photograph_is_read(root):
    entry = frame_entries(root)[0]
    entry["viewpoint"]["principal_point"] = [-1.6, -1.8]  # outside of the picture
    replace_frame_entries(root, [entry])
    (sequence,) = read_category(root, "cup")
    assert len(sequence.frames) == 1
