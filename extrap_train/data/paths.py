"""Paths that stand in files from outside: checked as text, and resolved below their folder."""

import os
import re
from pathlib import Path

from extrap_train.errors import InputError

MAX_NAME_BYTES = 255
"""Of a file or folder, on every common file system."""
# Absolute, on a Windows drive, with a `..` among its parts, or with a NUL that would end it early.
_LEAVES_FOLDER = re.compile(r"^[/\\]|^[A-Za-z]:|(^|[/\\])\.\.([/\\]|$)|\0")


def check_relative(relative: str, file: Path) -> str:
    """`relative` unchanged, if its text cannot lead out of a folder and a file may be called so.

    `file` is where it stood.
    """
    if not relative or _LEAVES_FOLDER.search(relative):
        raise InputError(
            f"{file}: the path {relative!r} is absolute, empty or climbs out of its folder; "
            "only paths below the data set's root can be read: correct the entry"
        )
    try:
        longest = max(map(len, os.fsencode(relative).split(b"/")))
    except UnicodeEncodeError:
        raise InputError(
            f"{file}: the path {relative!a} is no Unicode; correct the entry"
        ) from None
    if longest > MAX_NAME_BYTES:
        raise InputError(f"{file}: the path {relative[:60]!r}… has too long a name; correct it")
    return relative


def resolve_inside(root: Path, relative: str) -> Path:
    """The real path of an existing file below `root`, symbolic links followed.

    Raises InputError where it is missing or where a link leads out of `root`.
    """
    path = root / relative
    try:
        resolved = path.resolve()
        exists = resolved.is_file()
    except (OSError, RuntimeError, ValueError) as error:  # too long, or a loop of links
        reason = str(error).split(":")[0]
        raise InputError(f"{path}: no file can be there ({reason}); correct the entry") from None
    if not resolved.is_relative_to(root.resolve()):
        raise InputError(
            f"{path}: leads out of {root} to {resolved}; copy the file into the data set instead"
        )
    if not exists:
        raise InputError(f"{path}: no such file; restore it or remove its entry")
    return resolved


def file_stamp(path: Path) -> tuple[int, int] | None:
    """Size in bytes and time of the last change in nanoseconds; None where there is no such file.

    What says, without reading it, that a file is another one now.
    """
    try:
        found = path.stat()
    except (OSError, ValueError):
        return None
    return found.st_size, found.st_mtime_ns
