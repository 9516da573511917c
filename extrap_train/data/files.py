"""Files from outside, read with care, and files of ours, written whole or not at all."""

import os
import re
import shutil
import socket
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from filelock import FileLock, Timeout
from jaxtyping import Shaped

from extrap_train.errors import InputError

MAX_NAME_BYTES = 255
"""Of a file or folder, on every common file system."""
_WRITER = re.compile(r"\.(?P<host>[^.]+)-(?P<pid>\d+)(\.[^.]+)?\.tmp$")
_ABANDONED_S = 24 * 3600.0

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


def partial_beside(path: Path) -> Path:
    """Where this process writes what is to become `path`; says whose it is (`remove_partial`)."""
    return path.with_name(f".{path.name}.{_host()}-{os.getpid()}.tmp")


def write_whole(path: Path, content: bytes) -> None:
    """Write a file so that it is there complete or not at all; makes the folders above it."""
    temporary = partial_beside(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            temporary.write_bytes(content)
            replace_whole(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(
            f"{path}: cannot be written ({error.strerror}); free space or choose another folder"
        ) from None


def replace_whole(made: Path, path: Path) -> None:
    """Let a file that is complete become `path`, on the same file system, once it is on the disk.

    Renamed before, it could be there after a power cut with nothing in it.
    """
    _sync(made)
    made.replace(path)
    _sync(path.parent)


def save_array(path: Path, array: Shaped[np.ndarray, "..."]) -> int:
    """Write an array as NPY in C order; returns of how many bytes the file must be.

    Raises OSError with the number of the system's error. `numpy.save` writes through C's buffers:
    on a full disk its error has no number, or, where the last buffer is lost, there is none at all.
    """
    array = np.ascontiguousarray(array)
    with path.open("wb") as file:
        header = np.lib.format.header_data_from_array_1_0(array)
        np.lib.format.write_array_header_1_0(file, header)
        return file.tell() + file.write(array.data)


@contextmanager
def whole_folder(folder: Path, is_wanted: Callable[[Path], bool]) -> Iterator[Path]:
    """A folder to write into, which `put_in_place` at the end, or of which nothing stays behind."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    own = partial_beside(folder)
    made = Path(tempfile.mkdtemp(prefix=f"{own.stem}.", suffix=own.suffix, dir=folder.parent))
    try:
        yield made
        made.chmod(0o755)  # mkdtemp's folders are closed to everyone else
        put_in_place(made, folder, is_wanted)
    finally:
        shutil.rmtree(made, ignore_errors=True)


@contextmanager
def held_alone(lock: Path, otherwise: str) -> Iterator[None]:
    """What `lock` stands for, for this process alone as long as the block lasts.

    Raises InputError, which says `otherwise`, where another process holds it.
    """
    try:
        held = FileLock(lock).acquire(timeout=0)
    except Timeout:
        raise InputError(otherwise) from None
    with held:
        yield


def put_in_place(made: Path, folder: Path, is_wanted: Callable[[Path], bool]) -> None:
    """Let what was `made` become `folder`, on the same file system, once it is on the disk.

    What lay there is replaced, unless it is what is wanted: then another writer has come first, and
    its folder stays, so that nobody who reads it by now is disturbed. Whenever this process is
    killed, the folder is there whole, as it was or as it is now, or not at all.
    """
    for path in (*made.rglob("*"), made):
        _sync(path)
    with FileLock(folder.parent / ".lock"):
        if is_wanted(folder):
            return
        replaced = partial_beside(folder.with_name(f"{folder.name}.replaced"))
        if folder.exists():
            shutil.rmtree(replaced, ignore_errors=True)  # of an earlier process of the same number
            folder.rename(replaced)
        made.rename(folder)
        _sync(folder.parent)
    shutil.rmtree(replaced, ignore_errors=True)


def remove_partial(folder: Path) -> None:
    """Remove the `.*.tmp` that killed writers have left in a folder, which need not exist.

    What another process that lives still writes is left alone; of one on another machine it is
    removed after a day. This process must not be writing there.
    """
    for path in folder.glob(".*.tmp"):
        if _is_being_written(path):
            continue
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)  # another process may be removing it too
        else:
            path.unlink(missing_ok=True)


def _is_being_written(path: Path) -> bool:
    """Whether its writer may be alive; what vanishes meanwhile is one's who is."""
    writer = _WRITER.search(path.name)
    if writer is None or writer["pid"] == str(os.getpid()):
        return False
    if writer["host"] != _host():
        try:
            newest = max(p.stat().st_mtime for p in (path, *path.rglob("*")))
        except FileNotFoundError:
            return True
        return time.time() - newest < _ABANDONED_S
    try:
        os.kill(int(writer["pid"]), 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass  # somebody else's, and alive
    return True


def _host() -> str:
    return socket.gethostname().partition(".")[0]


def _sync(path: Path) -> None:
    """Bring a file or a folder's list of names to the disk: a name must not outlive its content."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
