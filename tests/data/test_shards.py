"""Shards in a folder hold what was prepared, no more of it is fetched than is read, and what is not
as it was written is named. `tests/test_training_from_shards.py` has them in an object store.
"""

import json
import pickle
import shutil
from pathlib import Path

import fsspec
import hydra
import numpy as np
import pytest
import torch
from fsspec.implementations.local import LocalFileSystem
from omegaconf import OmegaConf
from orbits import capture, even, ring
from prepared import prepared_captures

from data_prep.category_pairs import prepare_for_training
from extrap_train.cli import register_schemas
from extrap_train.config import TrainConfig
from extrap_train.data.examples import ExampleReader
from extrap_train.data.prepared import PreparedData
from extrap_train.data.sequences import FrameSequence
from extrap_train.data.shards import open_shards, write_shards
from extrap_train.errors import InputError


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> PreparedData:
    return prepared_captures(tmp_path_factory.mktemp("store") / "cup-1", _captures("abc"), {"c"})


def _captures(names: str) -> list[FrameSequence]:
    return [capture(ring(even(24)), name, depth=2 + ord(name) / 100) for name in names]


@pytest.fixture
def shards(data: PreparedData, tmp_path: Path) -> Path:
    write_shards(data, "cup", str(tmp_path / "shards"))
    return tmp_path / "shards"


def _fetched(cache: Path) -> list[Path]:
    return sorted(cache.rglob("frames.npy"))


def _shard(shards: Path, name: str) -> Path:
    """The file of the shard that is kept at a path like this."""
    listed = json.loads((shards / "cup/preparation.json").read_text())["shards"]
    (found,) = (shard["sha256"] for path, shard in listed.items() if path.endswith(name))
    return shards / "cup/files" / found


def test_examples_are_those_of_the_prepared_data(
    data: PreparedData, shards: Path, tmp_path: Path
) -> None:
    """In another process, too, where the data is opened anew."""
    opened = open_shards(str(shards), "cup", tmp_path / "cache")
    for split in ("train", "test"):
        expected = ExampleReader([data], split, 3)
        reader = pickle.loads(pickle.dumps(ExampleReader([opened], split, 3)))
        assert len(reader) == len(expected) > 20
        for index in range(0, len(reader), 7):
            assert reader.name(index) == expected.name(index)
            examples = [
                each.read(index, 3, np.random.default_rng(0)) for each in (reader, expected)
            ]
            for part in ("image", "reference_images", "reference_depths"):
                assert torch.equal(*(getattr(example, part) for example in examples)), part
    assert opened.roles == data.roles
    assert opened.manifest["key"] == data.manifest["key"]
    assert opened.manifest["split"] == data.manifest["split"]


def test_a_sequence_is_fetched_when_it_is_first_read(shards: Path, tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    opened = open_shards(str(shards), "cup", cache)
    assert not _fetched(cache)
    (name, *_) = opened.roles
    opened.images(name, [0])
    (fetched,) = _fetched(cache)
    shutil.rmtree(shards / "cup/files")
    open_shards(str(shards), "cup", cache).images(name, [1])
    assert _fetched(cache) == [fetched]


@pytest.mark.parametrize("how", ["changed", "cut", "gone"])
@pytest.mark.parametrize("name", ["cup/a/frames.npy", "pairs.parquet"])
def test_a_shard_that_is_not_as_it_was_written_is_named(
    shards: Path, tmp_path: Path, name: str, how: str
) -> None:
    shard = _shard(shards, name)
    content = shard.read_bytes()
    if how == "gone":
        shard.unlink()
    else:
        shard.write_bytes(content[:-1] + b"!" if how == "changed" else content[:-1])
    with pytest.raises(InputError, match=f"{shard.name}: .*{name} is ") as said:
        open_shards(str(shards), "cup", tmp_path / "cache").images("cup/a", [0])
    assert "\n" not in str(said.value)
    assert not list((tmp_path / "cache").rglob(name))


class _KilledError(Exception):
    pass


@pytest.mark.parametrize("after", [0, 3, 6])
def test_an_interrupted_upload_leaves_what_was_there_before(
    data: PreparedData, shards: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, after: int
) -> None:
    """And the next one sends only what is missing."""
    before = open_shards(str(shards), "cup", tmp_path / "cache")
    other = prepared_captures(tmp_path / "other" / "cup-2", _captures("cdef"), {"f"})
    sent, send = [], LocalFileSystem.put_file

    def put(store: LocalFileSystem, source: str, path: str, **options: object) -> None:
        if len(sent) == after:
            raise _KilledError
        sent.append(path)
        send(store, source, path, **options)

    with monkeypatch.context() as patch:
        patch.setattr(LocalFileSystem, "put_file", put)
        with pytest.raises(InputError, match="_KilledError"):
            write_shards(other, "cup", str(shards))
    again = open_shards(str(shards), "cup", tmp_path / "cache again")
    assert again.roles == before.roles == data.roles
    for name in again.roles:
        assert torch.equal(again.images(name, [0]), data.images(name, [0]))
    half = {path: Path(path).stat().st_mtime_ns for path in sent}
    write_shards(other, "cup", str(shards))
    assert half == {path: Path(path).stat().st_mtime_ns for path in sent}
    assert open_shards(str(shards), "cup", tmp_path / "cache").roles == other.roles


def test_a_first_upload_that_is_interrupted_is_no_upload(shards: Path, tmp_path: Path) -> None:
    (shards / "cup/preparation.json").unlink()
    with pytest.raises(InputError, match="no finished shards"):
        open_shards(str(shards), "cup", tmp_path / "cache")


@pytest.mark.parametrize(
    "change",
    [
        {"frames": "../../.."},
        {"pair_files": "/"},
        {"name": "../cup"},
        {"name": ".."},
        {"shards": {"pairs.parquet": {"sha256": "../../secret", "size": 1}}},
        {"shards": {"pairs.parquet": {"sha256": "0" * 64, "size": 2**50}}},
        {"shards": {"pairs.parquet": {"sha256": "0" * 64, "size": "1"}}},
        {"shards": {}},
        {"shards": None},
    ],
)
def test_a_manifest_leads_nowhere_else(
    shards: Path, tmp_path: Path, change: dict[str, object]
) -> None:
    """What it lists under names of its own is never asked for, so it is not written either."""
    file = shards / "cup/preparation.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | change))
    with pytest.raises(InputError):
        open_shards(str(shards), "cup", tmp_path / "cache")
    assert not [path for path in (tmp_path / "cache").rglob("*") if path.is_file()]


def test_a_manifest_without_end_is_not_read(shards: Path, tmp_path: Path) -> None:
    with (shards / "cup/preparation.json").open("r+b") as file:
        file.truncate(2**40)  # of which the disk holds next to nothing
    with pytest.raises(InputError, match="larger"):
        open_shards(str(shards), "cup", tmp_path / "cache")


@pytest.mark.parametrize(
    "address",
    ["s3://key:secret@bucket/x", "https://host/x?token=secret", "simplecache::s3://secret/x"],
)
def test_an_address_with_credentials_is_refused_unseen(address: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="shards") as said:
        open_shards(address, "cup", tmp_path)
    assert "secret" not in str(said.value)


def test_what_a_store_says_is_not_repeated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It may contain keys, as the address of an endpoint does."""

    def fail(url: str, **options: object) -> None:
        raise PermissionError(13, "no access with secret")

    monkeypatch.setattr(fsspec.core, "url_to_fs", fail)
    with pytest.raises(InputError, match="PermissionError, Permission denied") as said:
        open_shards("s3://x/y", "cup", tmp_path)
    assert "secret" not in str(said.value)


def test_a_store_without_its_library_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing(url: str, **options: object) -> None:
        raise ImportError("Install s3fs to access S3")

    monkeypatch.setattr(fsspec.core, "url_to_fs", missing)
    with pytest.raises(InputError, match=r"shards=s3://x/y/cup: .*extrap-train\[s3\]"):
        open_shards("s3://x/y", "cup", tmp_path)


def test_training_takes_no_shards_of_other_options(shards: Path, tmp_path: Path) -> None:
    """Its captures may be gone."""
    register_schemas()
    words = ["category=cup", "data=co3d", f"output={tmp_path}", f"shards={shards}"]
    with hydra.initialize_config_module("conf", version_base="1.3"):
        config = OmegaConf.to_object(hydra.compose("train", words))
    assert isinstance(config, TrainConfig)
    with pytest.raises(InputError, match=r"cup was prepared with (data|prep)\."):
        prepare_for_training(config)
