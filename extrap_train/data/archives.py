"""Captures that come as one zip archive, unpacked once into the user's cache."""

import logging
import posixpath
import shutil
import stat
import struct
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import NoReturn
from zipfile import ZIP_DEFLATED, ZIP_STORED, BadZipFile, ZipFile, ZipInfo

from extrap_train.data.json_files import GZIP_FLOOR_BYTES, GZIP_RATIO
from extrap_train.data.paths import check_relative, require_file
from extrap_train.errors import InputError
from extrap_train.store.cache import cache_entry, fill_entry
from extrap_train.store.digests import cache_folder, file_digest
from extrap_train.terminal import progress

ARCHIVE_SUFFIXES = (".zip", ".r3d")
"""`.r3d` is what Record3D calls its zip archives."""
MAX_FILES = 500_000
"""Five for each of the frames that a capture may have."""
_OF_CAPTURES = ("images", "keyframes", "rgbd", "sparse")
"""Folders that belong to a capture even where nothing is beside them."""
_PIECE_BYTES = 2**20
_MEBIBYTE = 2**20

log = logging.getLogger(__name__)


def is_archive(path: Path) -> bool:
    """Whether a file is called as an archive is."""
    return path.suffix.lower() in ARCHIVE_SUFFIXES and path.is_file()


def unpack_archive(path: Path) -> Path:
    """The folder of the capture in an archive, which is unpacked if it is not in the cache yet.

    A folder that holds nothing but another one is left for that one. Raises InputError where the
    archive is damaged or encrypted, or has paths that lead elsewhere, links, or too much content.
    """
    with _open(require_file(path)) as archive:
        members = _members(archive, path)
        stored = cache_entry("captures", path.stem, file_digest(path))

        def is_complete(folder: Path) -> bool:
            return folder.is_dir() and all(
                _size(folder / name) == info.file_size for name, info in members.items()
            )

        if not is_complete(stored):
            with fill_entry(stored, is_complete, "an unpacked capture") as made:
                _unpack(archive, members, made, path)
            log.warning("%s: is unpacked into %s", path, stored)
    return _single_folder(stored)


@contextmanager
def _open(path: Path) -> Iterator[ZipFile]:
    try:
        with ZipFile(path) as archive:
            yield archive
    except OSError as error:
        _refuse(path, f"cannot be read ({error.strerror}); check the file")
    except (BadZipFile, zlib.error, struct.error, EOFError, NotImplementedError, UnicodeError):
        _refuse(path, "is no zip archive, or a truncated or damaged one; export the capture again")


def _members(archive: ZipFile, path: Path) -> dict[str, ZipInfo]:
    """The files to unpack by their paths, which are all below a folder and of a sane size."""
    members: dict[str, ZipInfo] = {}
    length = path.stat().st_size
    for info in archive.infolist():
        listed = info.filename.replace("\\", "/")
        if listed.endswith("/") or listed.startswith("__MACOSX/"):
            continue
        if stat.S_IFMT(info.external_attr >> 16) not in (0, stat.S_IFREG):
            _refuse(path, f"{listed[:60]!a} is a link or a device; archive the file itself")
        if info.flag_bits & 1 or info.compress_type not in (ZIP_STORED, ZIP_DEFLATED):
            _refuse(path, f"{listed[:60]!a} is encrypted or not deflated; make a plain zip archive")
        name = posixpath.normpath(check_relative(listed, path))
        if name == "." or not 0 <= info.header_offset < length:
            raise BadZipFile
        if members.setdefault(name, info) is not info:
            _refuse(path, f"holds {name[:60]!a} twice; make the archive again")
    if len(members) > MAX_FILES:
        _refuse(path, f"holds more than {MAX_FILES:,} files; is it a capture of one scene?")
    _require_sane_size(sum(info.file_size for info in members.values()), path)
    for name in members:
        if any(str(folder) in members for folder in PurePosixPath(name).parents):
            _refuse(path, f"{name[:60]!a} lies in what is a file; make the archive again")
    return members


def _require_sane_size(size: int, path: Path) -> None:
    limit = GZIP_FLOOR_BYTES + GZIP_RATIO * path.stat().st_size
    if size > limit:
        _refuse(
            path,
            f"would be {size // _MEBIBYTE:,} MiB unpacked, which no real capture of its size is; "
            "get it again from a source you trust",
        )
    cache = cache_folder("captures")
    existing = next(folder for folder in (cache, *cache.parents) if folder.exists())
    free = shutil.disk_usage(existing).free
    if size > free:
        _refuse(
            path,
            f"takes {size // _MEBIBYTE:,} MiB unpacked, and {existing} has {free // _MEBIBYTE:,} "
            "left; set XDG_CACHE_HOME to a folder of yours with room",
        )


def _unpack(archive: ZipFile, members: Mapping[str, ZipInfo], made: Path, path: Path) -> None:
    """Write the files below `made`."""
    with progress(f"unpacking {path.name}", len(members), "files") as bar:
        for name, info in members.items():
            file = made / name
            file.parent.mkdir(parents=True, exist_ok=True)
            with archive.open(info) as packed, file.open("xb") as unpacked:
                shutil.copyfileobj(packed, unpacked, _PIECE_BYTES)
            if _size(file) != info.file_size:
                _refuse(path, f"{name[:60]!a} is not as long as it says; export the capture again")
            bar.advance()


def _size(file: Path) -> int | None:
    """In bytes; None where there is no regular file."""
    try:
        found = file.lstat()
    except OSError:
        return None
    return found.st_size if stat.S_ISREG(found.st_mode) else None


def _single_folder(folder: Path) -> Path:
    """The folder, or the one in it that is alone there, and so on; hidden files do not count."""
    while True:
        inside = [path for path in folder.iterdir() if not path.name.startswith(".")]
        if len(inside) != 1 or not inside[0].is_dir() or inside[0].name in _OF_CAPTURES:
            return folder
        folder = inside[0]


def _refuse(path: Path, fault: str) -> NoReturn:
    raise InputError(f"{path}: {fault}")
