"""An entry of a COLMAP model that makes no sense costs its picture and nothing else."""

import pytest
from captures import view_at
from PIL import Image
from test_colmap_model import Entry, write_binary, write_text

from extrap_train.data.colmap import read_model
from extrap_train.errors import InputError

_NAMES = ["00.png", "20.png", "40.png", "60.png"]


def _entries(folder):
    """Four images, whose pictures are there."""
    (folder / "images").mkdir()
    for name in _NAMES:
        Image.new("RGB", (40, 32)).save(folder / "images" / name)
    return [Entry(name, view_at(int(name[:2])).camera) for name in _NAMES]


@pytest.fixture
def text_model(tmp_path):
    write_text(tmp_path, _entries(tmp_path))
    return tmp_path


def read(model):
    return read_model(model, model / "images", "capture")


def _without_second(model, said):
    sequence = read(model)
    assert [frame.name for frame in sequence.frames] == ["00.png", "40.png", "60.png"]
    assert len(sequence.left_out) == 1
    assert said in sequence.left_out[0]


def _lines_of(model):
    return (model / "images.txt").read_text().splitlines()


def _write_lines(model, lines):
    (model / "images.txt").write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize("pose", ["nan 0 0 0 0 0 3", "1 0 0 0 -inf 0 3", "0 0 0 0 0 0 3"])
def test_a_bad_pose_costs_its_picture_alone(text_model, pose):
    lines = _lines_of(text_model)
    lines[3] = f"2 {pose} 7 20.png"
    _write_lines(text_model, lines)
    _without_second(text_model, "20.png")


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("2 1 0 0 0 0 0 3 seven 20.png", "20.png: "),
        ("2 1 0 0 null 0 0 3 7 20.png", "20.png: "),
        ("2 1 0 0 0 0 0 3 7", "images.txt: line 4 is malformed"),
        ("2 1 0 0 0 0 0", "images.txt: line 4 is malformed"),
        ("2", "images.txt: line 4 is malformed"),
        ("2 1 0 0 0 0 0 3 7 ../20.png", "../20.png"),
        ("2 1 0 0 0 0 0 3 7 /20.png", "/20.png"),
        ("2 1 0 0 0 0 0 3 9 20.png", "names camera 9"),
    ],
)
def test_a_line_that_makes_no_sense_costs_its_picture_alone(text_model, line, said, caplog):
    lines = _lines_of(text_model)
    lines[3] = line
    _write_lines(text_model, lines)
    _without_second(text_model, said)
    assert f"1 of 4 frames are left out: {read(text_model).left_out[0]}" in caplog.text


@pytest.mark.parametrize("write", [write_text, write_binary])
def test_a_name_that_is_not_utf_8_costs_its_picture_alone(tmp_path, write):
    write(tmp_path, _entries(tmp_path))
    (file,) = tmp_path.glob("images.*")
    file.write_bytes(file.read_bytes().replace(b"20.png", b"2\xe9.png"))
    _without_second(tmp_path, "is not plain text")


@pytest.mark.parametrize("write", [write_text, write_binary])
def test_equal_entries_of_a_picture_are_one_frame(tmp_path, write, caplog):
    entries = _entries(tmp_path)
    write(tmp_path, [*entries, entries[1]])
    sequence = read(tmp_path)
    assert [frame.name for frame in sequence.frames] == _NAMES
    assert sequence.left_out == ()
    assert "lists 1 pictures twice (20.png)" in caplog.text


@pytest.mark.parametrize("write", [write_text, write_binary])
def test_entries_that_contradict_each_other_cost_their_picture_alone(tmp_path, write):
    entries = _entries(tmp_path)
    write(tmp_path, [*entries, Entry("20.png", entries[0].camera)])
    _without_second(tmp_path, "lists 20.png twice")


_CAMERA = "PINHOLE 40 32 50 50 20 16"


@pytest.mark.parametrize(
    ("cameras", "said"),
    [
        (f"7 {_CAMERA}\n8 PINHOLE 40 x 50 50 20 16\n", "cameras.txt: line 2 is malformed"),
        (f"8 PINHOLE 40 32 a 50 20 16\n7 {_CAMERA}\n", "cameras.txt: line 1 is malformed"),
        (f"8\n7 {_CAMERA}\n", "cameras.txt: line 1 is malformed"),
        (f"8 {_CAMERA}\n8 PINHOLE 40 32 9 9 20 16\n7 {_CAMERA}\n", "lists camera 8 twice"),
    ],
)
def test_a_camera_that_makes_no_sense_costs_its_pictures_alone(text_model, cameras, said):
    (text_model / "cameras.txt").write_text(cameras)
    lines = _lines_of(text_model)
    lines[3] = lines[3].replace(" 7 20.png", " 8 20.png")
    _write_lines(text_model, lines)
    _without_second(text_model, said)


def test_equal_entries_of_a_camera_are_one_camera(text_model):
    (text_model / "cameras.txt").write_text(f"7 {_CAMERA}\n7 {_CAMERA}\n")
    assert len(read(text_model).frames) == 4


@pytest.mark.parametrize("first", ["seven", "PINHOLE", "\ufeff\ufeff7"])
def test_a_file_of_another_kind_is_no_list_of_cameras(text_model, first):
    (text_model / "cameras.txt").write_text(f"{first} {_CAMERA}\n")
    with pytest.raises(InputError, match=r"cameras\.txt: line 1 is malformed"):
        read(text_model)
