"""Whatever is wrong with a download is said in one line that names the file and a way out."""

import gzip
import zlib

import numpy as np
import pytest
from captures import frame_entries, replace_frame_entries, write_capture
from complaints import complaint_of
from PIL import Image

from extrap_train.data import json_files
from extrap_train.data.co3d import read_category, read_sequence

ANNOTATIONS = "frame_annotations.jgz"


@pytest.fixture
def root(tmp_path):
    write_capture(tmp_path, names=("one",), frames=1)
    return tmp_path


def load_first(root):
    read_category(root, "cup")[0].frames[0].load()


def test_missing_root(tmp_path):
    message = complaint_of(read_category, tmp_path / "nowhere", "cup")
    assert "nowhere: no such folder; set data.root" in message


def test_unknown_category_lists_those_present(root):
    assert "'cap'; categories present: cup" in complaint_of(read_category, root, "cap")


def test_category_climbing_out_is_unknown(root):
    assert "no category '../cup'" in complaint_of(read_category, root, "../cup")


@pytest.mark.parametrize("content", [[], {}, None, "text"])
def test_category_without_sequences(root, content):
    replace_frame_entries(root, content)
    assert f"{ANNOTATIONS}: expected annotations in a list" in complaint_of(
        read_category, root, "cup"
    )


def test_no_frame_with_a_camera(root):
    entry = frame_entries(root)[0] | {"viewpoint": None}
    replace_frame_entries(root, [entry])
    assert "no frame has a camera" in complaint_of(read_category, root, "cup")


def test_missing_sequence_annotations(root):
    (root / "cup" / "sequence_annotations.jgz").unlink()
    message = complaint_of(read_category, root, "cup")
    assert "sequence_annotations.jgz: no such file" in message


def test_truncated_annotations(root):
    file = root / "cup" / ANNOTATIONS
    file.write_bytes(file.read_bytes()[:-20])
    assert f"{ANNOTATIONS}: is a truncated or damaged gzip" in complaint_of(
        read_category, root, "cup"
    )


def test_damaged_annotations(root):
    file = root / "cup" / ANNOTATIONS
    content = bytearray(file.read_bytes())
    content[30:60] = b"\xff" * 30
    file.write_bytes(content)
    assert f"{ANNOTATIONS}: is a truncated or damaged gzip" in complaint_of(
        read_category, root, "cup"
    )


def test_annotations_that_are_not_gzip(root):
    (root / "cup" / ANNOTATIONS).write_text("[]")
    assert f"{ANNOTATIONS}: is not a gzip file" in complaint_of(read_category, root, "cup")


@pytest.mark.parametrize("content", [b"[{]", b"\xff\xfe\x00", b"[" * 10_000])
def test_annotations_that_are_not_json(root, content):
    (root / "cup" / ANNOTATIONS).write_bytes(gzip.compress(content))
    assert f"{ANNOTATIONS}: is not valid JSON" in complaint_of(read_category, root, "cup")


def test_gzip_bomb(root, monkeypatch):
    monkeypatch.setattr(json_files, "GZIP_FLOOR_BYTES", 1 << 20)
    bomb = gzip.compress(b"[" + b" " * (2 << 20))
    (root / "cup" / ANNOTATIONS).write_bytes(bomb)
    assert "holds more than" in complaint_of(read_category, root, "cup")


def test_missing_image(root):
    (root / frame_entries(root)[0]["image"]["path"]).unlink()
    assert "frame000001.jpg: no such file" in complaint_of(load_first, root)


@pytest.mark.parametrize("keep", [0, 10, 200])
def test_unreadable_image(root, keep):
    image = root / frame_entries(root)[0]["image"]["path"]
    image.write_bytes(image.read_bytes()[:keep])
    assert "frame000001.jpg: " in complaint_of(load_first, root)


def test_truncated_image(root):
    image = root / frame_entries(root)[0]["image"]["path"]
    image.write_bytes(image.read_bytes()[:-300])
    assert "frame000001.jpg: is truncated or damaged" in complaint_of(load_first, root)


def test_truncated_depth(root):
    depth = root / frame_entries(root)[0]["depth"]["path"]
    depth.write_bytes(depth.read_bytes()[:-100])
    assert "geometric.png: is truncated or damaged" in complaint_of(load_first, root)


@pytest.mark.parametrize("kind", ["image", "depth", "mask"])
def test_size_that_is_not_the_annotated_one(root, kind):
    file = root / frame_entries(root)[0][kind]["path"]
    Image.open(file).resize((20, 20)).save(file)
    message = complaint_of(load_first, root)
    assert f"{file.name}: is 20 x 20 pixels" in message
    assert "32 x 40" in message


def test_depth_with_eight_bits(root):
    file = root / frame_entries(root)[0]["depth"]["path"]
    Image.fromarray(np.ones((32, 40), np.uint8)).save(file)
    assert "has pixels of kind L" in complaint_of(load_first, root)


def test_depth_that_is_zero_everywhere(root):
    file = root / frame_entries(root)[0]["depth"]["path"]
    Image.fromarray(np.zeros((32, 40), np.uint16)).save(file)
    assert "depth map is zero everywhere" in complaint_of(load_first, root)
    assert "depth=stereo" in complaint_of(load_first, root)


@pytest.mark.parametrize("scale", [float("nan"), float("inf"), 0.0, -1.0, 1e30])
def test_a_scale_of_depth_that_is_no_positive_number(root, scale):
    entry = frame_entries(root)[0]
    entry["depth"]["scale_adjustment"] = scale
    replace_frame_entries(root, [entry])
    message = complaint_of(load_first, root)
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


def test_a_depth_scale_that_is_a_truth_value_is_none(root):
    entry = frame_entries(root)[0]
    entry["depth"]["scale_adjustment"] = True
    replace_frame_entries(root, [entry])
    assert "the scale of its depth is nan" in complaint_of(load_first, root)


def test_one_endless_entry_is_not_parsed(root):
    """A megabyte of gzip, which took five gigabytes."""
    packer = zlib.compressobj(9, zlib.DEFLATED, 31)
    out = packer.compress(b'[{"meta":[')
    for _ in range(16):
        out += packer.compress(b"[]," * 2**20)
    (root / "cup" / ANNOTATIONS).write_bytes(out + packer.compress(b"[]]}]") + packer.flush())
    assert ANNOTATIONS in complaint_of(read_category, root, "cup")


def test_mask_that_is_black_everywhere(root):
    file = root / frame_entries(root)[0]["mask"]["path"]
    Image.fromarray(np.zeros((32, 40), np.uint8)).save(file)
    assert file.name in complaint_of(load_first, root)


def test_unknown_sequence_suggests_near_names(root):
    assert "'onne'; did you mean one?" in complaint_of(read_sequence, root, "cup", "onne")
