"""Paths that stand in files from outside: their text is checked, the user's own links are followed.

A data set on several disks, a hub's cache, git-annex and DVC are made of symbolic links, so a link
may lead anywhere; a text in a file that somebody else wrote may not.
"""

import os
import re
import stat
from pathlib import Path

from extrap_train.errors import InputError

MAX_NAME_BYTES = 255
"""Longest name of a file or folder on every common file system."""
MAX_PATH_BYTES = 4095
# Absolute, on a Windows drive, with a `..` among its parts, or with a NUL that would end it early.
_LEAVES_FOLDER = re.compile(r"^[/\\]|^[A-Za-z]:|(^|[/\\])\.\.([/\\]|$)|\0")
_UNPRINTABLE = re.compile("[\x01-\x1f\x7f-\x9f\ud800-\udfff]")
"""Control characters and halves of surrogate pairs."""


def check_relative(relative: str, file: Path) -> str:
    """`relative` unchanged, if its text cannot lead out of a folder and a file may be called so.

    `file` is where it stood.
    """
    if not relative or _LEAVES_FOLDER.search(relative):
        raise InputError(
            f"{file}: the path {relative[:60]!a} is absolute, empty or climbs out of its folder; "
            "only paths below the data set's root can be read: correct the entry"
        )
    if _UNPRINTABLE.search(relative):
        raise InputError(f"{file}: the path {relative[:60]!a} is not plain text; correct the entry")
    encoded = os.fsencode(relative)
    if len(encoded) > MAX_PATH_BYTES or max(map(len, encoded.split(b"/"))) > MAX_NAME_BYTES:
        raise InputError(f"{file}: the path {relative[:60]!r}… has too long a name; correct it")
    return relative


def require_file(path: Path) -> Path:
    """`path`, if a regular file is there, links followed; a pipe or a device would never end."""
    try:
        mode = path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        if path.is_symlink():
            raise InputError(
                f"{path}: is a link to {path.readlink()}, where no file is; fetch that file (git "
                "annex get, dvc pull) or remove its entry"
            ) from None
        raise InputError(f"{path}: no such file; restore it or remove its entry") from None
    except (OSError, RuntimeError, ValueError) as error:  # too long, a loop of links, no permission
        reason = error.strerror if isinstance(error, OSError) else "no valid path"
        raise InputError(f"{path}: cannot be read ({reason}); correct the entry") from None
    if not stat.S_ISREG(mode):
        raise InputError(f"{path}: is not a regular file; put the file itself there")
    return path


def file_stamp(path: Path) -> tuple[int, int] | None:
    """Size in bytes and time of the last change in nanoseconds; None where there is no such file.

    What says, without reading it, that a file is another one now.
    """
    try:
        found = path.stat()
    except (OSError, ValueError):
        return None
    return found.st_size, found.st_mtime_ns
