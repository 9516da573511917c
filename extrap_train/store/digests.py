"""SHA-256 of values and of files; a large file's is computed once and kept in the user's cache."""

import hashlib
import json
import os
import re
import time
from collections.abc import Iterable, Iterator, Set
from contextlib import suppress
from pathlib import Path
from typing import Any

from extrap_train.errors import InputError
from extrap_train.store.atomic import write_atomic

_MODEL_SUFFIXES = (".safetensors", ".json", ".bin", ".ckpt", ".pt", ".pth")
_LARGE_BYTES = 64 * 2**20
"""Larger files are worth a record: below, hashing takes less than a tenth of a second."""
_SETTLED_NS = 2 * 10**9
"""A file that changed more recently may change again within one tick of its clock."""


def file_digest(path: Path) -> str:
    """SHA-256 of a file's content.

    A large file is read again only if its path, size, modification and change times or inode
    changed. Raises InputError if it cannot be read.
    """
    if path.exists() and not path.is_file():
        raise InputError(f"{path}: is not a regular file; give one")  # a pipe would never end
    try:
        stamp = _stamp(path)
        if stamp[0] < _LARGE_BYTES:
            return _hash_file(path)
        name = hashlib.sha256(os.fsencode(path.resolve())).hexdigest()
        record = cache_folder("digests") / name
        if (known := _read_known(record, stamp)) is not None:
            return known
        digest = _hash_file(path)
        settled = time.time_ns() - max(stamp[1:3]) > _SETTLED_NS
        if settled and _stamp(path) == stamp:
            with suppress(InputError):  # a full or read-only home costs only time
                write_atomic(record, f"{digest} {stamp}".encode())
        return digest
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None


def json_digest(content: Any) -> str:
    """SHA-256 of a JSON value, whatever the order of its keys."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def files_below(folder: Path, above: Set[Path] = frozenset()) -> Iterator[Path]:
    """All files below a folder, sorted; links are followed, but not back to a folder `above`.

    Raises InputError where a folder cannot be read.
    """
    here = folder.resolve()
    if here in above:
        return
    try:
        entries = sorted(folder.iterdir())
    except OSError as error:
        raise InputError(f"{folder}: cannot be read ({error.strerror})") from None
    for path in entries:
        if path.is_dir():
            yield from files_below(path, {*above, here})
        elif path.is_file():
            yield path


def folder_digest(folder: Path) -> str:
    """SHA-256 of the names and contents of all files below a folder, wherever it lies."""
    return _files_digest(folder, files_below(folder))


def _files_digest(folder: Path, files: Iterable[Path]) -> str:
    digest = hashlib.sha256()
    for path in files:
        digest.update(f"{path.relative_to(folder).as_posix()}\0{file_digest(path)}\n".encode())
    return digest.hexdigest()


def model_files(folder: Path) -> Iterator[Path]:
    """The files of a model's folder that are read, sorted; what other tools put beside them, as a
    card, is none of them.
    """
    return (path for path in files_below(folder) if path.suffix in _MODEL_SUFFIXES)


def weights_digest(weights: Path) -> str:
    """SHA-256 of a file of weights, or of a model's folder."""
    if weights.is_dir():
        return _files_digest(weights, model_files(weights))
    return file_digest(weights)


def _hash_file(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _stamp(path: Path) -> list[int]:
    found = path.stat()
    return [found.st_size, found.st_mtime_ns, found.st_ctime_ns, found.st_ino]


def cache_folder(kind: str) -> Path:
    """Where this user keeps what can be computed again, by what it is."""
    given = os.environ.get("XDG_CACHE_HOME")
    return Path(given or Path.home() / ".cache") / "extrap-train" / kind


def _read_known(record: Path, stamp: list[int]) -> str | None:
    """None where there is none yet, it is of another content or damaged: the file itself says."""
    try:
        known, _, known_stamp = record.read_text().partition(" ")
    except (OSError, ValueError):
        return None
    is_same = known_stamp == str(stamp)
    return known if is_same and re.fullmatch("[0-9a-f]{64}", known) else None
