"""Depth files of other sizes, kinds and shapes than their photograph."""

import os
from pathlib import Path

import numpy as np
import pytest
import torch
from complaints import complaint_about
from PIL import Image

from extrap_train.data.depth_files import DepthFile
from extrap_train.data.image_files import same_view

_RNG = np.random.default_rng(0)
_DEPTH = _RNG.integers(1, 60_000, (6, 8)).astype(np.uint16)


def read_depth(path: Path, size: tuple[int, int], scale: float = 1.0) -> torch.Tensor:
    return DepthFile(path.name, scale).read(path.parent, size)


def _save_depth(path: Path, raw: np.ndarray) -> Path:
    if path.suffix == ".npy":
        np.save(path, raw)
    else:
        Image.fromarray(raw).save(path)
    return path


@pytest.mark.parametrize("times", [1, 2, 4])
@pytest.mark.parametrize(
    ("name", "kind"),
    [("d.png", "u2"), ("d.npy", "u2"), ("d.npy", "f4"), ("d.npy", "f8"), ("d.tif", "f4")],
)
def test_depth_of_fewer_pixels_is_that_of_the_nearest(tmp_path, name, kind, times):
    path = _save_depth(tmp_path / name, _DEPTH.astype(kind))
    found = read_depth(path, (6 * times, 8 * times), 0.001).numpy()
    # Pixel centres: a wide pixel covers its own place and no other.
    assert np.allclose(found, np.kron(_DEPTH, np.ones((times, times))) * 0.001, rtol=1e-6)


@pytest.mark.parametrize(("name", "kind"), [("d.png", "u2"), ("d.npy", "u2"), ("d.npy", ">u2")])
def test_the_largest_number_of_sixteen_bits_is_no_depth(tmp_path, name, kind):
    raw = _DEPTH.astype(kind)
    raw[2:4, 3] = 65_535
    found = read_depth(_save_depth(tmp_path / name, raw), (6, 8), 0.001).numpy()
    assert np.allclose(found, np.where(raw == 65_535, 0, _DEPTH) * 0.001, rtol=1e-6)


def test_depth_of_more_pixels_is_sampled(tmp_path):
    large = np.kron(_DEPTH, np.ones((3, 3), np.uint16))
    path = _save_depth(tmp_path / "d.png", large)
    assert np.array_equal(read_depth(path, (6, 8)), _DEPTH)


def test_depth_of_another_shape_is_refused_with_both_sizes(tmp_path):
    png = _save_depth(tmp_path / "d.png", _DEPTH)
    npy = _save_depth(tmp_path / "d.npy", _DEPTH)
    for path in (png, npy):
        said = complaint_about(read_depth, path, (64, 64), 1.0)
        assert "64" in said
        assert "6" in said


def test_an_array_with_a_channel_is_depth(tmp_path):
    path = _save_depth(tmp_path / "d.npy", _DEPTH[..., None])
    assert np.array_equal(read_depth(path, (6, 8), 1.0).numpy(), _DEPTH)


def _npz_called_npy(path: Path) -> None:
    with path.open("wb") as file:
        np.savez(file, depth=_DEPTH)


@pytest.mark.parametrize(
    "write",
    [
        _npz_called_npy,
        lambda path: path.write_bytes(b""),
        lambda path: path.write_bytes(b"\x93NUMPY\x01\x00\x10\x00" + b"(" * 16),
        lambda path: np.save(path, np.array([[object()]]), allow_pickle=True),
        lambda path: np.save(path, np.ones((6, 8), complex)),
        lambda path: np.save(path, np.ones((6, 8), bool)),
        lambda path: np.save(path, np.array("text")),
        lambda path: os.mkfifo(path),
    ],
)
def test_what_is_no_depth_array_is_refused(tmp_path, write):
    write(tmp_path / "d.npy")
    complaint_about(read_depth, tmp_path / "d.npy", (6, 8), 1.0)


def test_colours_and_eight_bits_are_no_depth(tmp_path):
    for mode in ("RGB", "L", "1"):
        Image.new(mode, (8, 6), 1).save(tmp_path / "d.png")
        complaint_about(read_depth, tmp_path / "d.png", (6, 8), 1.0)


@pytest.mark.parametrize("size", [(192, 256), (193, 256), (191, 256)])
def test_rounded_sizes_are_of_one_shape(size):
    assert same_view(size, (1440, 1920))
    assert same_view((1440, 1920), size)


@pytest.mark.parametrize(
    ("size", "other"),
    [((24, 24), (96, 128)), ((32, 24), (96, 128)), ((1080, 1920), (1200, 1920)), ((1, 1), (2, 3))],
)
def test_other_shapes_are_not(size, other):
    assert not same_view(size, other)
    assert not same_view(other, size)
