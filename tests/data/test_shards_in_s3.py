"""Shards in an object store are read as those in a folder, however the store answers."""

import json
from collections.abc import Iterator
from pathlib import Path

import fsspec
import numpy as np
import pytest
import torch
from object_store import ObjectStore, serve_objects
from orbits import capture, even, ring
from prepared import prepared_captures

from extrap_train.data.examples import ExampleReader
from extrap_train.data.prepared import PreparedData
from extrap_train.data.shards import open_shards, write_shards
from extrap_train.errors import InputError


@pytest.fixture(scope="module")
def store() -> Iterator[ObjectStore]:
    with serve_objects() as store:
        yield store


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> PreparedData:
    captures = [capture(ring(even(24)), name, depth=2 + ord(name) / 100) for name in "abc"]
    return prepared_captures(tmp_path_factory.mktemp("data") / "cup-1", captures, {"c"})


@pytest.fixture
def address(store: ObjectStore, data: PreparedData, request: pytest.FixtureRequest) -> str:
    """Fresh shards, under a prefix of their own."""
    name = "".join(letter if letter.isalnum() else "-" for letter in request.node.name)
    write_shards(data, "cup", f"{store.url}/{name}")
    store.fetched.clear()
    return f"{store.url}/{name}"


def _shard(address: str, name: str) -> str:
    """The address of the shard that is kept at this path."""
    listed = json.loads(fsspec.filesystem("s3").cat_file(f"{address}/cup/preparation.json"))
    return f"{address}/cup/files/{listed['shards'][name]['sha256']}"


def test_examples_are_those_of_the_prepared_data_and_each_shard_is_fetched_once(
    store: ObjectStore, data: PreparedData, address: str, tmp_path: Path
) -> None:
    for _ in range(2):  # the second time from what the first fetched
        opened = open_shards(address, "cup", tmp_path)
        for split in ("train", "test"):
            ours, local = (ExampleReader([each], split, 3) for each in (opened, data))
            assert len(ours) == len(local) > 20
            for index in range(0, len(local), 7):
                read, wanted = (r.read(index, 3, np.random.default_rng(0)) for r in (ours, local))
                for part in ("image", "reference_images", "reference_depths"):
                    assert torch.equal(getattr(read, part), getattr(wanted, part)), part
    assert len(store.fetched) == len(set(store.fetched)) == len(opened.roles) + 4


@pytest.mark.parametrize("block_bytes", [50 * 2**20, 5 * 2**10])
def test_a_read_that_breaks_off_is_taken_up_again(
    store: ObjectStore,
    data: PreparedData,
    address: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    block_bytes: int,
) -> None:
    """Also of a shard that is larger than the blocks that s3fs would fetch side by side."""
    monkeypatch.setattr("s3fs.S3FileSystem.default_block_size", block_bytes)
    opened = open_shards(address, "cup", tmp_path)
    store.cuts = 2
    assert torch.equal(opened.images("cup/a", [0, 5]), data.images("cup/a", [0, 5]))
    assert store.cuts == 0


def test_a_read_that_always_breaks_off_names_the_shard(
    store: ObjectStore, address: str, tmp_path: Path
) -> None:
    opened, shard = (
        open_shards(address, "cup", tmp_path),
        _shard(address, "frames/cup/a/frames.npy"),
    )
    store.cuts = 1000
    try:
        with pytest.raises(InputError) as said:
            opened.images("cup/a", [0])
    finally:
        store.cuts = 0
    assert str(said.value).startswith(f"{shard}: ")
    assert "\n" not in str(said.value)
    assert not list(tmp_path.rglob("frames.npy"))


@pytest.mark.parametrize("how", ["flipped", "truncated", "missing"])
def test_a_shard_that_is_not_as_it_was_written_is_named(
    address: str, tmp_path: Path, how: str
) -> None:
    opened, shard = (
        open_shards(address, "cup", tmp_path),
        _shard(address, "frames/cup/a/frames.npy"),
    )
    bucket = fsspec.filesystem("s3")
    content = bucket.cat_file(shard)
    if how == "missing":
        bucket.rm_file(shard)
    else:
        end = b"" if how == "truncated" else bytes([content[-1] ^ 1])
        bucket.pipe_file(shard, content[:-1] + end)
    with pytest.raises(InputError) as said:
        opened.images("cup/a", [0])
    assert str(said.value).startswith(f"{shard}: frames/cup/a/frames.npy is ")
    assert "\n" not in str(said.value)
    assert not list(tmp_path.rglob("frames.npy"))
