"""Prepared data in a folder or an object store, of which training fetches what it reads.

<shards>/<category>/preparation.json   as `data.prepared` describes it, and which shards there are
                    files/<sha256>     a shard: a table, split.json, all frames of a sequence, …

A shard is fetched whole when it is first read, checked, and kept on the local disk, so examples are
read in any order. It is named by its content and never changes. The manifest is written last: until
then, an interrupted or a repeated upload leaves what the manifest before it names as it was.
"""

import hashlib
import json
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from filelock import FileLock

from extrap_train.config import check_shards_address
from extrap_train.data.frame_files import table_digest
from extrap_train.data.prepared import TABLES, PreparedData
from extrap_train.errors import InputError
from extrap_train.store.atomic import atomic_file, write_atomic
from extrap_train.store.digests import file_digest
from extrap_train.store.records import MAX_RECORD_BYTES, parse_record
from extrap_train.terminal import track

_MANIFEST, _SPLIT = "preparation.json", "split.json"
_REMEDY = "write the shards again with data_prep shards="
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,199}")
_SHA256 = re.compile(r"[0-9a-f]{64}")
_MAX_SHARD_BYTES = 16 * 2**30
"""200 frames of 512² take 0.06 GB."""
_BESIDE = "."
"""Where a manifest says that frames and pairs lie: beside it."""


@dataclass(frozen=True)
class _Shard:
    sha256: str
    size: int


@dataclass(frozen=True)
class _Manifest:
    """What `preparation.json` of shards says besides what that of prepared data does."""

    frames: str
    pair_files: str
    name: str
    """Of the folder that was prepared."""
    shards: dict[str, _Shard]
    """By the path below the folder that each is kept at."""

    @property
    def is_sound(self) -> bool:
        """Whether it leads to no other place, and to nothing too large."""
        names = {self.frames, self.pair_files} == {_BESIDE} and _NAME.fullmatch(self.name)
        return bool(names) and all(
            _SHA256.fullmatch(shard.sha256) and 0 <= shard.size <= _MAX_SHARD_BYTES
            for shard in self.shards.values()
        )


@dataclass(frozen=True)
class _Place:
    """A folder or a prefix of an object store."""

    url: str

    @classmethod
    def of(cls, address: str, category: str) -> "_Place":
        check_shards_address(address)
        return cls(f"{address.rstrip('/')}/{category}")

    def read(self, name: str) -> bytes | None:
        """A small file's content, or None; what is larger than a record is cut."""
        with self._opened(name) as (store, path):
            try:
                content: bytes = store.cat_file(path, start=0, end=MAX_RECORD_BYTES + 1)
            except FileNotFoundError:
                return None
            return content

    def size(self, name: str) -> int | None:
        """A file's size in bytes, or None where it is not there."""
        with self._opened(name) as (store, path):
            try:
                return int(store.info(path)["size"])
            except FileNotFoundError:
                return None

    def download(self, name: str, to: Path) -> None:
        """Copy a file to the local disk."""
        with self._opened(name) as (store, path):
            # By itself, s3fs goes on where a read broke off; several at once, it gives up.
            store.get_file(path, str(to), max_concurrency=1)

    def upload(self, content: Path | bytes, name: str) -> None:
        """Write a file: a copy of a local one, or these bytes."""
        with self._opened(name) as (store, path):
            if "file" in store.protocol:  # an object store has no folders: it would make a bucket
                Path(path).parent.mkdir(parents=True, exist_ok=True)
            if isinstance(content, Path):
                store.put_file(str(content), path)
            else:
                store.pipe_file(path, content)

    @contextmanager
    def _opened(self, name: str) -> Iterator[tuple[Any, str]]:
        """The store and the file's path in it. InputError for what fails, without the error's text,
        which may hold credentials.
        """
        import fsspec

        try:
            store, root = fsspec.core.url_to_fs(self.url, use_listings_cache=False)
            yield store, f"{root.rstrip('/')}/{name}"
        except ImportError as error:
            raise InputError(
                f"shards={self.url}: {error}; for s3:// pip install 'extrap-train[s3]'"
            ) from None
        except Exception as error:  # every store has errors of its own
            number = error.errno if isinstance(error, OSError) else None
            reason = f", {os.strerror(number)}" if number else ""
            raise InputError(
                f"{self.url}/{name}: cannot be read or written ({type(error).__name__}{reason}); "
                "check the address, the store's environment variables and your access"
            ) from None


@dataclass(frozen=True)
class _Fetcher:
    """Fetches files of the folder, where they are missing, from the shards of one category."""

    place: _Place
    folder: Path
    shards: dict[str, _Shard]

    def __call__(self, file: Path) -> None:
        """InputError, which names the shard, where it is missing or not what was written."""
        name = file.relative_to(self.folder).as_posix()
        shard = self.shards.get(name)
        if shard is None:
            raise InputError(f"{self.place.url}: has no shard {name}; {_REMEDY}")
        if _size(file) == shard.size:
            return
        file.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(f"{file}.lock"):  # other processes wait for the one that fetches it
            if _size(file) != shard.size:
                with atomic_file(file) as temporary:
                    self._get(name, shard, temporary)

    def _get(self, name: str, shard: _Shard, to: Path) -> None:
        remote = f"files/{shard.sha256}"
        size = self.place.size(remote)
        if size is None:
            problem = "is missing"
        elif size != shard.size:
            problem = f"is damaged ({size} bytes instead of {shard.size})"
        else:
            self.place.download(remote, to)
            if table_digest(to) == shard.sha256:
                return
            problem = "is damaged (its SHA-256 is another)"
        raise InputError(
            f"{self.place.url}/{remote}: {name} {problem}; delete the shard if it is there, and "
            f"{_REMEDY}"
        )


def write_shards(data: PreparedData, category: str, address: str) -> None:
    """Write a category's prepared data as shards; those that are there already are not sent again.

    Raises InputError where the store cannot be written.
    """
    place = _Place.of(address, category)
    files = {name: data.folder / name for name in (*_tables(), _SPLIT)}
    for sequence in data.roles:
        files |= {file.relative_to(root).as_posix(): file for root, file in data.files(sequence)}
    shards = {name: _Shard(file_digest(file), file.stat().st_size) for name, file in files.items()}
    beside = _Manifest(_BESIDE, _BESIDE, data.folder.name, shards)
    if not beside.is_sound:
        raise InputError(f"{data.folder}: a file is larger than {_MAX_SHARD_BYTES} bytes")
    manifest = json.dumps(data.manifest | asdict(beside), indent=1).encode()
    sent = 0
    for name, file in track(files.items(), f"writing shards of {category}", len(files), "files"):
        remote = f"files/{shards[name].sha256}"
        if place.size(remote) != shards[name].size:
            place.upload(file, remote)
            sent += 1
    if place.read(_MANIFEST) != manifest:
        place.upload(manifest, _MANIFEST)
    print(f"shards: {place.url} ({sent} files sent, {len(files) - sent} there before)")


def open_shards(address: str, category: str, cache: Path) -> PreparedData:
    """A category's prepared data, whose shards are fetched to a folder of `cache` as they are read.

    InputError where there are none, or the manifest or the tables are not what was written.
    """
    place = _Place.of(address, category)
    content = place.read(_MANIFEST)
    if content is None:
        raise InputError(f"{place.url}: holds no finished shards; {_REMEDY}")
    manifest = parse_record(content, f"{place.url}/{_MANIFEST}", _Manifest, _REMEDY)
    if not manifest.is_sound:
        raise InputError(f"{place.url}/{_MANIFEST}: is not a manifest of shards; {_REMEDY}")
    # The folder's name names held-out views, and so determines their noise.
    folder = cache / hashlib.sha256(content).hexdigest()[:16] / manifest.name
    fetch = _Fetcher(place, folder, manifest.shards)
    for name in (*_tables(), _SPLIT):
        fetch(folder / name)
    write_atomic(folder / _MANIFEST, content)
    return PreparedData.open(folder, fetch)


def _tables() -> list[str]:
    return [f"{name}.parquet" for name in TABLES]


def _size(file: Path) -> int | None:
    return file.stat().st_size if file.exists() else None
