"""Whatever is wrong with a download is said in one line that names the file and a way out."""

import gzip
import json
import zlib

import numpy as np
import pytest
from captures import frame_entries, replace_frame_entries, write_capture
from PIL import Image

from extrap_train.data import json_files
from extrap_train.data.co3d import read_category, read_sequence
from extrap_train.errors import InputError

ANNOTATIONS = "frame_annotations.jgz"


@pytest.fixture
def root(tmp_path):
    write_capture(tmp_path, names=("one",), frames=1)
    return tmp_path


def complaint(read, *arguments) -> str:
    with pytest.raises(InputError) as caught:
        read(*arguments)
    message = str(caught.value)
    assert "\n" not in message
    assert ";" in message, "says what to do after a semicolon"
    return message


def load_first(root):
    read_category(root, "cup")[0].frames[0].load()


def test_missing_root(tmp_path):
    message = complaint(read_category, tmp_path / "nowhere", "cup")
    assert "nowhere: no such folder; set data.root" in message


def test_unknown_category_lists_those_present(root):
    assert "'cap'; categories present: cup" in complaint(read_category, root, "cap")


def test_category_climbing_out_is_unknown(root):
    assert "no category '../cup'" in complaint(read_category, root, "../cup")


@pytest.mark.parametrize("content", [[], {}, None, "text"])
def test_category_without_sequences(root, content):
    replace_frame_entries(root, content)
    assert f"{ANNOTATIONS}: expected annotations in a list" in complaint(read_category, root, "cup")


def test_no_frame_with_a_camera(root):
    entry = frame_entries(root)[0] | {"viewpoint": None}
    replace_frame_entries(root, [entry])
    assert "no frame has a camera" in complaint(read_category, root, "cup")


def test_missing_sequence_annotations(root):
    (root / "cup" / "sequence_annotations.jgz").unlink()
    message = complaint(read_category, root, "cup")
    assert "sequence_annotations.jgz: no such file" in message


def test_truncated_annotations(root):
    file = root / "cup" / ANNOTATIONS
    file.write_bytes(file.read_bytes()[:-20])
    assert f"{ANNOTATIONS}: is a truncated or damaged gzip" in complaint(read_category, root, "cup")


def test_damaged_annotations(root):
    file = root / "cup" / ANNOTATIONS
    content = bytearray(file.read_bytes())
    content[30:60] = b"\xff" * 30
    file.write_bytes(content)
    assert f"{ANNOTATIONS}: is a truncated or damaged gzip" in complaint(read_category, root, "cup")


def test_annotations_that_are_not_gzip(root):
    (root / "cup" / ANNOTATIONS).write_text("[]")
    assert f"{ANNOTATIONS}: is not a gzip file" in complaint(read_category, root, "cup")


@pytest.mark.parametrize("content", [b"[{]", b"\xff\xfe\x00", b"[" * 10_000])
def test_annotations_that_are_not_json(root, content):
    (root / "cup" / ANNOTATIONS).write_bytes(gzip.compress(content))
    assert f"{ANNOTATIONS}: is not valid JSON" in complaint(read_category, root, "cup")


def test_gzip_bomb(root, monkeypatch):
    monkeypatch.setattr(json_files, "GZIP_FLOOR_BYTES", 1 << 20)
    bomb = gzip.compress(b"[" + b" " * (2 << 20))
    (root / "cup" / ANNOTATIONS).write_bytes(bomb)
    assert "holds more than" in complaint(read_category, root, "cup")


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
    message = complaint(read_category, root, "cup")
    assert ANNOTATIONS in message
    assert expected in message


@pytest.mark.parametrize("entry", [None, 3, [], "text"])
def test_entries_that_are_no_objects(root, entry):
    replace_frame_entries(root, [entry])
    assert "entry 0 is malformed" in complaint(read_category, root, "cup")


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
        assert "climbs out of its folder" in complaint(read_category, root, "cup")


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
    message = complaint(read_category, root, "cup")
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
    message = complaint(read_sequence, tmp_path, "cup", "one")
    assert "one: none of its frames can be used: " in message


def test_missing_image(root):
    (root / frame_entries(root)[0]["image"]["path"]).unlink()
    assert "frame000001.jpg: no such file" in complaint(load_first, root)


@pytest.mark.parametrize("keep", [0, 10, 200])
def test_unreadable_image(root, keep):
    image = root / frame_entries(root)[0]["image"]["path"]
    image.write_bytes(image.read_bytes()[:keep])
    assert "frame000001.jpg: " in complaint(load_first, root)


def test_truncated_image(root):
    image = root / frame_entries(root)[0]["image"]["path"]
    image.write_bytes(image.read_bytes()[:-300])
    assert "frame000001.jpg: is truncated or damaged" in complaint(load_first, root)


def test_truncated_depth(root):
    depth = root / frame_entries(root)[0]["depth"]["path"]
    depth.write_bytes(depth.read_bytes()[:-100])
    assert "geometric.png: is truncated or damaged" in complaint(load_first, root)


@pytest.mark.parametrize("kind", ["image", "depth", "mask"])
def test_size_that_is_not_the_annotated_one(root, kind):
    file = root / frame_entries(root)[0][kind]["path"]
    Image.open(file).resize((20, 20)).save(file)
    message = complaint(load_first, root)
    assert f"{file.name}: is 20 x 20 pixels" in message
    assert "says 32 x 40" in message


def test_depth_with_eight_bits(root):
    file = root / frame_entries(root)[0]["depth"]["path"]
    Image.fromarray(np.ones((32, 40), np.uint8)).save(file)
    assert "has pixels of kind L" in complaint(load_first, root)


def test_depth_that_is_zero_everywhere(root):
    file = root / frame_entries(root)[0]["depth"]["path"]
    Image.fromarray(np.zeros((32, 40), np.uint16)).save(file)
    assert "depth map is zero everywhere" in complaint(load_first, root)
    assert "depth=stereo" in complaint(load_first, root)


@pytest.mark.parametrize("scale", [float("nan"), float("inf"), 0.0, -1.0, 1e30])
def test_a_scale_of_depth_that_is_no_positive_number(root, scale):
    entry = frame_entries(root)[0]
    entry["depth"]["scale_adjustment"] = scale
    replace_frame_entries(root, [entry])
    message = complaint(load_first, root)
    assert f"geometric.png: the scale of its depth is {scale}, no possible one" in message
    assert "depth=stereo" in message


def test_depth_that_is_not_asked_for_is_not_read(root):
    frame = read_category(root, "cup")[0].frames[0]
    whole = frame.load()
    (root / frame_entries(root)[0]["depth"]["path"]).write_bytes(b"no picture")
    without = frame.load(depth=False)
    assert without.depth is None
    np.testing.assert_array_equal(without.image, whole.image)
    np.testing.assert_array_equal(without.mask, whole.mask)


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


def test_a_depth_scale_that_is_a_truth_value_is_none(root):
    entry = frame_entries(root)[0]
    entry["depth"]["scale_adjustment"] = True
    replace_frame_entries(root, [entry])
    assert "the scale of its depth is nan" in complaint(load_first, root)


@pytest.mark.parametrize(("old", "new"), [("/", "/./"), ("/", "//"), ("images/", "images/././")])
def test_an_image_that_is_listed_twice_in_other_words(root, old, new):
    (entry,) = frame_entries(root)
    again = json.loads(json.dumps(entry)) | {"frame_number": 99}
    again["image"]["path"] = entry["image"]["path"].replace(old, new, 1)
    replace_frame_entries(root, [entry, again])
    assert "sequence one lists an image twice" in complaint(read_category, root, "cup")


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
    assert "has an entry of more than" in complaint(read_category, root, "cup")


def test_one_endless_entry_is_not_parsed(root):
    """A megabyte of gzip, which took five gigabytes."""
    packer = zlib.compressobj(9, zlib.DEFLATED, 31)
    out = packer.compress(b'[{"meta":[')
    for _ in range(16):
        out += packer.compress(b"[]," * 2**20)
    (root / "cup" / ANNOTATIONS).write_bytes(out + packer.compress(b"[]]}]") + packer.flush())
    assert ANNOTATIONS in complaint(read_category, root, "cup")


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


def test_mask_that_is_black_everywhere(root):
    file = root / frame_entries(root)[0]["mask"]["path"]
    Image.fromarray(np.zeros((32, 40), np.uint8)).save(file)
    assert "mask is black everywhere" in complaint(load_first, root)


def test_an_image_that_is_listed_twice(root):
    replace_frame_entries(root, frame_entries(root) * 2)
    assert "sequence one lists an image twice" in complaint(read_category, root, "cup")


def test_unknown_sequence_suggests_near_names(root):
    assert "'onne'; did you mean one?" in complaint(read_sequence, root, "cup", "onne")


@pytest.mark.parametrize("letter", [0xD800, 0xDCFF])
@pytest.mark.parametrize("file", ["frame_annotations.jgz", "sequence_annotations.jgz"])
def test_a_name_that_is_no_unicode(root, file, letter):
    path = root / "cup" / file
    entries = json.loads(gzip.decompress(path.read_bytes()))
    entries[0]["sequence_name"] = f"s5{chr(letter)}"
    path.write_bytes(gzip.compress(json.dumps(entries).encode()))
    message = complaint(read_category, root, "cup")
    assert f"{file}: entry 0 is malformed (sequence_name 's5\\u{letter:x}' is no" in message
