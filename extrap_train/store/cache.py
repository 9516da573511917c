"""Folders in the user's cache: what can be made again, filled once and complete or not at all."""

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from extrap_train.errors import InputError
from extrap_train.store.atomic import atomic_folder, remove_leftovers
from extrap_train.store.digests import cache_folder, folder_digest


def cache_entry(kind: str, name: str, key: str) -> Path:
    """Where something of this kind is kept; `key` is the digest of all that it depends on."""
    plain_name = re.sub(r"[^\w.-]", "_", name)[:60]
    return cache_folder(kind) / f"{plain_name}-{key[:16]}"


@contextmanager
def fill_entry(entry: Path, is_sound: Callable[[Path], bool], content: str) -> Iterator[Path]:
    """A new folder that becomes `entry`, unless another process has made a sound one meanwhile.

    Raises InputError, which names the `content`, where it cannot be written.
    """
    try:
        remove_leftovers(entry.parent)
        with atomic_folder(entry, is_sound) as made:
            yield made
    except OSError as error:
        raise InputError(
            f"{error.filename or entry}: {error.strerror}, so that {content} cannot be kept; set "
            "XDG_CACHE_HOME to a folder of yours with room"
        ) from None


def seal(made: Path, part: str) -> None:
    """Write down what the folder `part` of an entry contains."""
    (made / f"{part}.sha256").write_text(folder_digest(made / part))


def is_intact(entry: Path, part: str) -> bool:
    """Whether the folder `part` is there as it was when it was sealed."""
    file = entry / f"{part}.sha256"
    return file.is_file() and file.read_bytes() == folder_digest(entry / part).encode()
