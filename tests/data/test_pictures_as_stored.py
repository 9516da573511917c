"""Picture files as cameras, cutters and strangers write them."""

import io
import os
import stat
from pathlib import Path

import numpy as np
import pytest
import torch
from complaints import complaint_about
from PIL import Image

from extrap_train.data import image_files
from extrap_train.data.depth_files import DepthFile
from extrap_train.data.image_files import (
    FORMATS,
    image_size,
    read_grey,
    read_mask,
    read_photograph,
)

_ORIENTATION = 0x0112


_HEIGHT, _WIDTH = 6, 10


_RNG = np.random.default_rng(0)


_UPRIGHT = _RNG.integers(0, 256, (_HEIGHT, _WIDTH, 3)).astype(np.uint8)


# How a camera held each way stores an upright scene, written out from the EXIF standard:
# where the stored picture's row 0 and column 0 are in the upright one.
_STORED = {
    1: _UPRIGHT,
    2: _UPRIGHT[:, ::-1],  # row 0 top, column 0 right
    3: _UPRIGHT[::-1, ::-1],  # bottom, right
    4: _UPRIGHT[::-1],  # bottom, left
    5: _UPRIGHT.swapaxes(0, 1),  # left, top
    6: _UPRIGHT[:, ::-1].swapaxes(0, 1),  # right, top
    7: _UPRIGHT[::-1, ::-1].swapaxes(0, 1),  # right, bottom
    8: _UPRIGHT[::-1].swapaxes(0, 1),  # left, bottom
}


_QUARTER_TURNS = (5, 6, 7, 8)


def read_image(path: Path, size: tuple[int, int]) -> torch.Tensor:
    return read_photograph(path, size)[0]


def read_depth(path: Path, size: tuple[int, int], scale: float = 1.0) -> torch.Tensor:
    return DepthFile(path.name, scale).read(path.parent, size)


def read_half_depth(path: Path, size: tuple[int, int]) -> torch.Tensor:
    return DepthFile(path.name, 1.0, is_half_float=True).read(path.parent, size)


def save_with_tag(path: Path, pixels: np.ndarray, tag: int) -> Path:
    exif = Image.Exif()
    exif[_ORIENTATION] = tag
    Image.fromarray(pixels).save(path, exif=exif)
    return path


def to_bytes(image: torch.Tensor) -> np.ndarray:
    return (image * 255).round().byte().permute(1, 2, 0).numpy()


@pytest.mark.parametrize("tag", _QUARTER_TURNS)
@pytest.mark.parametrize("name", ["photo.png", "photo.tif"])
def test_the_annotated_size_says_which_way_a_camera_holds_its_picture(tmp_path, name, tag, caplog):
    stored = _STORED[tag]
    path = save_with_tag(tmp_path / name, stored, tag)
    assert np.array_equal(to_bytes(read_image(path, (_HEIGHT, _WIDTH))), _UPRIGHT)
    assert np.array_equal(to_bytes(read_image(path, (_WIDTH, _HEIGHT))), stored)
    assert image_size(path, (_HEIGHT * 2, _WIDTH * 2)) == (_HEIGHT, _WIDTH)
    assert image_size(path, (_WIDTH, _HEIGHT)) == (_WIDTH, _HEIGHT)
    assert not caplog.records


def test_a_turned_jpeg_is_turned(tmp_path):
    halves = np.zeros((32, 64, 3), np.uint8)
    halves[:, :32] = 255  # white on the left
    path = save_with_tag(tmp_path / "IMG_1.JPG", halves[:, ::-1].swapaxes(0, 1), 6)
    image = read_image(path, (32, 64))
    assert image[:, :, :24].min() > 0.9
    assert image[:, :, 40:].max() < 0.1


@pytest.mark.parametrize("tag", _QUARTER_TURNS)
def test_a_turned_picture_without_annotated_size_is_refused(tmp_path, tag):
    path = save_with_tag(tmp_path / "IMG_1.JPG", _STORED[tag], tag)
    assert "add w and h" in complaint_about(image_size, path)


@pytest.mark.parametrize("tag", [2, 3, 4])
def test_a_turn_that_keeps_the_size_is_said(tmp_path, tag, caplog):
    for name in ("one.png", "two.png"):
        path = save_with_tag(tmp_path / name, _STORED[tag], tag)
        assert np.array_equal(to_bytes(read_image(path, (_HEIGHT, _WIDTH))), _STORED[tag])
    assert image_size(path) == (_HEIGHT, _WIDTH)
    (record,) = caplog.records  # one for a folder
    assert str(tmp_path) in record.getMessage()
    assert "orientation" in record.getMessage()


def test_a_square_that_may_be_turned_is_said(tmp_path, caplog):
    square = _STORED[6][:_HEIGHT, :_HEIGHT]
    path = save_with_tag(tmp_path / "square.png", square, 6)
    assert image_size(path) == (_HEIGHT, _HEIGHT)
    assert np.array_equal(to_bytes(read_image(path, (_HEIGHT, _HEIGHT))), square)
    assert len(caplog.records) == 1


def test_nonsense_as_orientation_is_none(tmp_path, caplog):
    for tag in (0, 9, 65535):
        path = save_with_tag(tmp_path / f"{tag}.png", _UPRIGHT, tag)
        assert np.array_equal(to_bytes(read_image(path, (_HEIGHT, _WIDTH))), _UPRIGHT)
    assert not caplog.records


def test_a_wrong_size_names_both_sizes_and_the_orientation(tmp_path):
    path = save_with_tag(tmp_path / "a.png", _STORED[6], 6)
    said = complaint_about(read_image, path, (7, 7))
    assert "10 x 6" in said
    assert "6 x 10" in said
    assert "7 x 7" in said


_RED, _HIDDEN = (200, 30, 20), (255, 0, 255)


def _cut_out(mode: str) -> tuple[Image.Image, dict]:
    """A picture whose left half is transparent over a hidden colour, and how it is saved."""
    rgba = Image.new("RGBA", (8, 4), (*_HIDDEN, 0))
    rgba.paste((*_RED, 255), (4, 0, 8, 4))
    if mode == "RGBA":
        return rgba, {}
    if mode == "LA":
        return rgba.convert("LA"), {}
    index = Image.new("L" if mode == "L" else "P", (8, 4), 0)
    index.paste(90, (4, 0, 8, 4))
    if mode == "P":
        index.putpalette([*_HIDDEN] + [0] * 89 * 3 + [*_RED])
        return index, {"transparency": 0}
    if mode == "L":
        return index, {"transparency": 0}
    rgb = Image.new("RGB", (8, 4), _HIDDEN)
    rgb.paste(_RED, (4, 0, 8, 4))
    return rgb, {"transparency": _HIDDEN}


@pytest.mark.parametrize("mode", ["RGBA", "LA", "P", "L", "RGB"])
def test_transparency_is_the_mask_and_shows_white(tmp_path, mode):
    picture, options = _cut_out(mode)
    picture.save(tmp_path / "cut.png", **options)
    image, mask = read_photograph(tmp_path / "cut.png", (4, 8))
    assert torch.equal(mask, torch.tensor([0.0] * 4 + [1.0] * 4).expand(4, 8))
    assert (image[:, :, :4] == 1).all()
    if mode in ("RGBA", "P", "RGB"):
        assert tuple(to_bytes(image)[0, 7]) == _RED


def test_half_transparent_is_blended(tmp_path):
    Image.new("RGBA", (4, 4), (0, 0, 0, 51)).save(tmp_path / "veil.png")
    image, mask = read_photograph(tmp_path / "veil.png", (4, 4))
    torch.testing.assert_close(mask, torch.full((4, 4), 0.2))
    torch.testing.assert_close(image, torch.full((3, 4, 4), 0.8))


def test_an_opaque_alpha_is_no_mask(tmp_path):
    Image.new("RGBA", (4, 4), (10, 20, 30, 255)).save(tmp_path / "opaque.png")
    image, mask = read_photograph(tmp_path / "opaque.png", (4, 4))
    assert mask is None
    assert tuple(to_bytes(image)[0, 0]) == (10, 20, 30)


def test_a_mask_file_and_transparency_together(tmp_path):
    _cut_out("RGBA")[0].save(tmp_path / "cut.png")
    mask = np.zeros((4, 8), np.uint8)
    mask[:2] = 255
    Image.fromarray(mask).save(tmp_path / "mask.png")
    found = read_photograph(tmp_path / "cut.png", (4, 8), tmp_path / "mask.png")[1]
    assert found.sum() == 8
    assert (found[:2, 4:] == 1).all()
    Image.new("L", (8, 4)).save(tmp_path / "mask.png")
    complaint_about(read_photograph, tmp_path / "mask.png", (4, 8), tmp_path / "mask.png")
    Image.new("RGBA", (8, 4), (9, 9, 9, 0)).save(tmp_path / "nothing.png")
    complaint_about(read_photograph, tmp_path / "nothing.png", (4, 8))


def test_a_cut_out_as_mask_is_black_where_it_is_transparent(tmp_path):
    picture = Image.new("RGBA", (8, 4), (255, 255, 255, 0))
    picture.paste((255, 255, 255, 255), (4, 0, 8, 4))
    picture.save(tmp_path / "mask.png")
    mask = read_mask(tmp_path / "mask.png", (4, 8))
    assert torch.equal(mask, torch.tensor([0.0] * 4 + [1.0] * 4).expand(4, 8))


@pytest.mark.parametrize(("white", "edge"), [(1, 1), (255, 255), (255, 128)])
@pytest.mark.parametrize("alpha", ["one pixel", "254 throughout"])
def test_a_black_and_white_mask_stays_one_whatever_its_transparency(tmp_path, alpha, edge, white):
    truth = np.zeros((32, 32), np.uint8)
    truth[8:20, 8:20] = white
    truth[8, 8:20] = edge
    pixels = np.dstack([truth, truth, truth, np.full_like(truth, 255)])
    pixels[..., 3] = 254 if alpha == "254 throughout" else pixels[..., 3]
    pixels[0, 0, 3] = 0
    Image.fromarray(pixels).save(tmp_path / "mask.png")
    mask = read_mask(tmp_path / "mask.png", (32, 32))
    torch.testing.assert_close(mask, torch.from_numpy(truth) / white, rtol=0, atol=1.01 / 255)


def test_a_mask_of_zero_and_one_is_black_and_white(tmp_path):
    truth = _RNG.integers(0, 2, (6, 10)).astype(np.uint8)
    Image.fromarray(truth).save(tmp_path / "mask.png")
    assert np.array_equal(read_mask(tmp_path / "mask.png", (6, 10)).numpy(), truth)


def test_colours_of_print_are_understood(tmp_path):
    Image.new("RGB", (16, 16), (250, 10, 10)).convert("CMYK").save(tmp_path / "print.jpg")
    red, green, blue = read_image(tmp_path / "print.jpg", (16, 16)).mean((1, 2))
    assert red > 0.9
    assert max(green, blue) < 0.15


def test_sixteen_bits_of_grey_are_no_photograph(tmp_path):
    Image.fromarray(np.full((4, 4), 40_000, np.uint16)).save(tmp_path / "grey.png")
    complaint_about(read_image, tmp_path / "grey.png", (4, 4))


def test_masks_of_another_size_are_resampled(tmp_path):
    small = np.array([[0, 255], [255, 0], [0, 0]], np.uint8)
    Image.fromarray(small).save(tmp_path / "mask.png")
    wanted = torch.from_numpy(np.kron(small > 0, np.ones((4, 4)))).float()
    assert torch.equal(read_mask(tmp_path / "mask.png", (12, 8)), wanted)
    assert np.array_equal(read_grey(tmp_path / "mask.png", (12, 8)) > 0, wanted)
    complaint_about(read_mask, tmp_path / "mask.png", (8, 12))


@pytest.mark.parametrize("format_name", sorted({*Image.SAVE} - {"PDF"} | {"EPS", "PCX", "SGI"}))
def test_other_formats_are_refused_whatever_their_name(tmp_path, format_name, monkeypatch):
    content = io.BytesIO()
    try:
        Image.new("RGB", (32, 32), (1, 2, 3)).save(content, format_name)
    except (OSError, ValueError, KeyError, AttributeError, TypeError):
        pytest.skip("cannot be written here")
    path = tmp_path / "photo.png"
    path.write_bytes(content.getvalue())
    shown = {"JPEG2000": "JPEG2000", "MPO": "JPEG", "DIB": "BMP"}.get(format_name, format_name)
    if shown in FORMATS and format_name != "DIB":
        assert read_image(path, (32, 32)).shape == (3, 32, 32)
    else:
        complaint_about(read_image, path, (32, 32))


def test_no_program_is_started_for_postscript(tmp_path, monkeypatch):
    tools = tmp_path / "bin"
    tools.mkdir()
    called = tmp_path / "called"
    ghostscript = tools / "gs"
    ghostscript.write_text(f"#!/bin/sh\ntouch {called}\n")
    ghostscript.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tools}:{os.environ['PATH']}")
    content = io.BytesIO()
    Image.new("RGB", (8, 8)).save(content, "EPS")
    for name in ("photo.png", "mask.jpg", "depth.tif", "postscript.eps"):
        (tmp_path / name).write_bytes(content.getvalue())
        for read in (read_image, read_mask, read_half_depth):
            complaint_about(read, tmp_path / name, (8, 8))
        complaint_about(image_size, tmp_path / name)
        complaint_about(read_depth, tmp_path / name, (8, 8), 1.0)
    assert not called.exists()


def test_a_pipe_or_device_is_no_picture(tmp_path):
    os.mkfifo(tmp_path / "pipe.png")
    for path in (tmp_path / "pipe.png", Path("/dev/zero"), tmp_path):
        assert not stat.S_ISREG(path.stat().st_mode)
        complaint_about(read_image, path, (8, 8))
        complaint_about(image_size, path)
        complaint_about(read_depth, path, (8, 8), 1.0)


def test_heic_names_what_reads_it(tmp_path, monkeypatch):
    path = tmp_path / "IMG_1.HEIC"
    path.write_bytes(b"\0\0\0\x24ftypheic" + b"\0" * 200)
    monkeypatch.setitem(__import__("sys").modules, "pillow_heif", None)
    said = complaint_about(image_size, path)
    assert "extrap-train[heic]" in said
    assert "JPEG" in said


def test_heic_is_read_with_its_extra(tmp_path):
    heif = pytest.importorskip("pillow_heif", reason="needs pillow-heif: the extra `heic`")
    path = tmp_path / "IMG_1.HEIC"
    heif.from_pillow(Image.new("RGB", (64, 48), (200, 100, 50))).save(path)
    image = read_image(path, (48, 64))
    assert abs(image.mean((1, 2)) - torch.tensor([200, 100, 50]) / 255).max() < 0.03
    path.write_bytes(path.read_bytes()[:150])
    complaint_about(read_image, path, (48, 64))


def test_sizes_beyond_the_limit_are_refused_before_anything_is_decoded(tmp_path, monkeypatch):
    Image.new("L", (20, 10)).save(tmp_path / "bomb.png")
    monkeypatch.setattr(image_files, "MAX_PIXELS", 199)
    monkeypatch.setattr(Image.Image, "load", lambda self: pytest.fail("was decoded"))
    complaint_about(image_size, tmp_path / "bomb.png")
    complaint_about(read_image, tmp_path / "bomb.png", (10, 20))
