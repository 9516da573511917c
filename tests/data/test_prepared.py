import json
import pickle
from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from orbits import capture, even, ring

from data_prep.preparation import prepare
from extrap_train.config import PrepConfig
from extrap_train.data.frame_files import (
    SealedTable,
    SequenceFrames,
    StoredFrames,
    frames_folder,
    map_array,
    write_frames,
)
from extrap_train.data.prepared import PreparedData
from extrap_train.depth import DatasetDepth
from extrap_train.errors import InputError

SIZE = 16


@pytest.mark.parametrize("order", ["C", "F"])
def test_a_mapped_array_keeps_no_descriptor(tmp_path: Path, order: str) -> None:
    """A training on several categories maps thousands, and a process may open about 1024 files."""
    array = np.asarray(np.arange(6.0).reshape(2, 3), order=order)
    np.save(tmp_path / "x.npy", array)
    before = len(list(Path("/proc/self/fd").iterdir()))
    mapped = map_array(tmp_path / "x.npy")
    assert len(list(Path("/proc/self/fd").iterdir())) == before
    np.testing.assert_array_equal(mapped, array)
    assert not mapped.flags.writeable


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    sequences = [capture(ring(even(24)), name, depth=2.5) for name in ("a", "b", "c", "d")]
    target = tmp_path_factory.mktemp("store") / "cup"
    options = PrepConfig(image_size=SIZE)
    prepare(
        sequences,
        DatasetDepth(),
        options,
        test_names={"c"},
        folder=target,
        progress=False,
        source={"root": "a disk", "seed": 3},
    )
    return target


def test_frames_come_as_they_went_in(folder: Path) -> None:
    data = PreparedData.open(folder)
    images, depths = data.images("cup/b", [5, 0, 23]), data.depths("cup/b", [5, 0, 23])
    assert images.shape == (3, 3, SIZE, SIZE)
    np.testing.assert_allclose(images[:, 0, 0, 0] / 255, [5 / 24, 0, 23 / 24], atol=0.5 / 255)
    np.testing.assert_allclose(depths * data.depth_unit("cup/b"), 2.5, rtol=2**-11)
    assert data.names("cup/b")[5] == "frame5"


def test_cameras_are_those_of_the_square_frames(folder: Path) -> None:
    camera = PreparedData.open(folder).cameras("cup/a")
    expected = ring(even(24)).cropped(0, 8, 48, 48).resized(SIZE, SIZE)
    torch.testing.assert_close(camera.world_to_cam, expected.world_to_cam)
    torch.testing.assert_close(camera.intrinsics, expected.intrinsics)
    assert (camera.height, camera.width) == (SIZE, SIZE)


def test_pairs_stay_within_their_split(folder: Path) -> None:
    data = PreparedData.open(folder)
    train, test = data.pairs("train"), data.pairs("test")
    assert {pair.sequence for pair in train} == {"cup/a", "cup/b", "cup/d"}
    assert {pair.sequence for pair in test} == {"cup/c"}
    assert len(train) == len(list(train)) == 3 * len(test)
    angle = train.angle_rad[0]
    assert train[0].score == pytest.approx(np.cos(angle) * (1 - np.cos(angle)))
    with pytest.raises(ValueError, match="train or test"):
        data.pairs("validation")


def test_a_million_pairs_do_not_repeat_their_names(folder: Path) -> None:
    pairs = PreparedData.open(folder).pairs("train")
    assert len(pairs) > len(set(pairs.sequence))
    for words in (pairs.sequence, pairs.uncorrected):
        assert len({id(word) for word in words}) == len(set(words))


def test_another_process_gets_the_folder_not_the_frames(folder: Path) -> None:
    data = PreparedData.open(folder)
    data.images("cup/a", [0])
    content = pickle.dumps(data)
    assert len(content) < 1000
    assert len(pickle.loads(content).pairs("train")) == len(data.pairs("train"))


@given(exponent=st.floats(-12, 12), seed=st.integers(0, 99))
@settings(max_examples=30, deadline=None)
def test_depth_survives_in_any_unit(exponent: float, seed: int, tmp_path_factory) -> None:
    rng = np.random.default_rng(seed)
    depths = (rng.uniform(0.2, 50, (2, 4, 4)) * 10**exponent).astype(np.float32)
    depths[0, 0, 0] = 0
    target = tmp_path_factory.mktemp("unit") / "one"
    bytes_ = np.zeros((2, 4, 4), np.uint8)
    camera = ring(even(2))
    frames = SequenceFrames(("x", "y"), camera, np.stack([bytes_] * 3, -1), depths, bytes_)
    place = SealedTable(target / "frames.parquet", "key")
    write_frames(place, frames)
    table = place.read()
    assert table is not None
    stored = StoredFrames(target, table, 4)
    for index, depth in enumerate(depths):
        np.testing.assert_allclose(stored.view(index).depth, depth, rtol=2**-11)
    assert SealedTable(place.file, "another key").read() is None


def test_masks_come_back_where_the_object_covers_half_of_a_pixel(tmp_path: Path) -> None:
    masks = np.random.default_rng(0).integers(0, 256, (2, 5, 5)).astype(np.uint8)
    images, depths = np.zeros((2, 5, 5, 3), np.uint8), np.ones((2, 5, 5), np.float32)
    place = SealedTable(tmp_path / "one" / "frames.parquet", "key")
    write_frames(place, SequenceFrames(("x", "y"), ring(even(2)), images, depths, masks))
    table = place.read()
    assert table is not None
    stored = StoredFrames(place.file.parent, table, 5)
    for index, mask in enumerate(masks):
        assert np.array_equal(stored.mask(index), mask >= 128)


def test_no_flipped_bit_of_a_table_changes_its_cameras(tmp_path: Path) -> None:
    camera, blank = ring(even(4)), np.zeros((4, 4, 4), np.uint8)
    images, depths = np.stack([blank] * 3, -1), np.ones((4, 4, 4), np.float32)
    place = SealedTable(tmp_path / "one" / "frames.parquet", "key")
    write_frames(place, SequenceFrames(tuple("abcd"), camera, images, depths, blank))
    whole, table = place.file.read_bytes(), place.read()
    assert table is not None
    rng, refused = np.random.default_rng(0), 0
    for _ in range(300):
        content = bytearray(whole)
        content[rng.integers(len(whole))] ^= 1 << int(rng.integers(8))
        place.file.write_bytes(content)
        found = place.read()
        refused += found is None
        assert found is None or found.equals(table)
    assert refused > 100


@pytest.mark.parametrize(
    "name",
    [
        "../../etc/x",
        "/abs/x",
        "cup/../..",
        "cup/..",
        "cup/a/../../b",
        "cup/\0",
        "cup/" + "x" * 300,
        "/",
    ],
)
def test_untrusted_names_stay_inside(name: str, tmp_path: Path) -> None:
    folder = frames_folder(tmp_path, name)
    assert (tmp_path / "frames") in folder.resolve().parents
    assert all(len(part) <= 100 for part in folder.parts)


def test_names_that_look_alike_as_files_stay_apart(tmp_path: Path) -> None:
    assert frames_folder(tmp_path, "cup/a b") != frames_folder(tmp_path, "cup/a_b")
    assert frames_folder(tmp_path, "cup/a b") != frames_folder(tmp_path, "cup/a/b")
    assert frames_folder(tmp_path, "cup/0003") == tmp_path / "frames" / "cup" / "0003"


@pytest.mark.parametrize("name", ["preparation.json", "pairs.parquet", "frames.parquet"])
@pytest.mark.parametrize("content", [b"", b"garbage", b"{}"])
def test_damage_is_one_line(folder: Path, name: str, content: bytes) -> None:
    file = folder / name
    whole = file.read_bytes()
    file.write_bytes(content)
    try:
        with pytest.raises(InputError, match="damaged") as caught:
            PreparedData.open(folder)
    finally:
        file.write_bytes(whole)
    assert str(folder) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("change", ["column", "bit"])
def test_a_table_that_was_changed_is_damage_and_is_not_parsed(folder: Path, change: str) -> None:
    file = folder / "frames.parquet"
    whole = file.read_bytes()
    if change == "column":
        pq.write_table(pq.read_table(file).drop_columns(["intrinsics"]), file)
    else:
        file.write_bytes(whole[:-20] + bytes([whole[-20] ^ 1]) + whole[-19:])
    try:
        with pytest.raises(InputError, match=r"damaged.*frames\.parquet"):
            PreparedData.open(folder)
    finally:
        file.write_bytes(whole)


@pytest.mark.parametrize(
    "change",
    [
        {"options": {"image_size": 10**9}},
        {"options": {"image_size": "large"}},
        {"options": []},
        {"frames": 5},
        {"tables": {}},
        {"sequences": {"kept": "4", "dropped": 0, "failed": 0}},
        {"format": 3},
    ],
)
def test_a_manifest_of_other_types_or_sizes_is_damage(folder: Path, change: dict) -> None:
    file = folder / "preparation.json"
    whole = file.read_text()
    file.write_text(json.dumps(json.loads(whole) | change))
    try:
        with pytest.raises(InputError, match="damaged"):
            PreparedData.open(folder).images("cup/d", [0])
    finally:
        file.write_text(whole)


@pytest.mark.parametrize("shape", ["(4000000, 2000, 2000, 3)", "(2,)", "(-1, 5)", "0" * 99])
def test_an_array_that_says_another_size_is_damage(folder: Path, shape: str) -> None:
    """Before memory of that size is asked for."""
    file = folder / "frames" / "cup" / "d" / "frames.npy"
    whole = file.read_bytes()
    header = f"{{'descr': '|u1', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    file.write_bytes(b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode())
    try:
        with pytest.raises(InputError, match="damaged"):
            PreparedData.open(folder).images("cup/d", [0])
    finally:
        file.write_bytes(whole)


def test_a_truncated_frame_file_is_damage(folder: Path) -> None:
    file = folder / "frames" / "cup" / "d" / "frames.npy"
    whole = file.read_bytes()
    file.write_bytes(whole[:1000])
    try:
        with pytest.raises(InputError, match="damaged"):
            PreparedData.open(folder).images("cup/d", [0])
    finally:
        file.write_bytes(whole)


@pytest.mark.parametrize("place", [0.1, 0.5, 0.999])
def test_a_changed_byte_is_found_when_its_frame_is_read(folder: Path, place: float) -> None:
    """A JPEG with one would be another picture, and no error."""
    file = folder / "frames" / "cup" / "d" / "frames.npy"
    whole = file.read_bytes()
    at = 128 + int(place * (len(whole) - 128))
    file.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
    data = PreparedData.open(folder)

    def read_all() -> None:
        for index in range(24):
            data.images("cup/d", [index])
            data.depths("cup/d", [index])
            data.mask("cup/d", index)

    try:
        with pytest.raises(InputError, match=r"frames\.npy is damaged .*frame \d+"):
            read_all()
    finally:
        file.write_bytes(whole)


def test_an_unfinished_preparation_says_so(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no finished preparation"):
        PreparedData.open(tmp_path)


def test_the_manifest_states_what_it_was_made_from(folder: Path) -> None:
    manifest = json.loads((folder / "preparation.json").read_text())
    assert manifest["options"]["image_size"] == SIZE
    assert manifest["depth"] == "DatasetDepth()"
    assert manifest["data"] == {"root": "a disk", "seed": 3}
    assert manifest["versions"]["opencv-python-headless"].startswith(cv2.__version__)
    assert manifest["sequences"] == {"kept": 4, "dropped": 0, "failed": 0}
