"""Files and folders that are written complete or not at all, and the locks around them."""

import os
import re
import secrets
import shutil
import socket
import stat
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from filelock import FileLock, Timeout
from jaxtyping import Shaped

from extrap_train.errors import InputError

_REPLACED = ".replaced"
_PARTIAL = re.compile(r"\.(?P<name>.+)\.(?P<host>[^.]+)-(?P<pid>\d+)(\.[^.]+)?\.tmp", re.DOTALL)
"""A name that `partial_path` gives."""
_ABANDONED_S = 24 * 3600.0


def partial_path(path: Path) -> Path:
    """Where this process writes what is to become `path`; says whose it is (`remove_leftovers`)."""
    return path.with_name(f".{path.name}.{_host()}-{os.getpid()}.tmp")


def link_target(path: Path) -> Path:
    """Where a path leads once every link in it is followed, which need not exist."""
    return Path(os.path.realpath(path))  # `Path.resolve` raises where links form a circle


def write_atomic(path: Path, content: bytes) -> None:
    """Write a file so that it is there complete or not at all; makes the folders above it."""
    with atomic_file(path) as temporary:
        temporary.write_bytes(content)


def replace_synced(made: Path, path: Path) -> None:
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
def atomic_file(path: Path) -> Iterator[Path]:
    """A temporary name to write a file under, which becomes `path` at the end, or leaves no trace.

    The file's mode follows the umask, whatever library writes it. Raises InputError if the disk is
    full or closed.
    """
    temporary = partial_path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            temporary.touch()
            mode = stat.S_IMODE(temporary.stat().st_mode)
            yield temporary
            temporary.chmod(mode)
            replace_synced(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(
            f"{path}: cannot be written ({error.strerror or error}); free space or choose another "
            "folder"
        ) from None


@contextmanager
def atomic_folder(
    folder: Path, is_wanted: Callable[[Path], bool] = lambda _: False
) -> Iterator[Path]:
    """A new folder that `install_folder` puts in place at the end, or of which nothing remains.

    Where `folder` is a link, the link stays and its target is replaced. Modes follow the
    umask, whatever library writes the files.
    """
    folder = link_target(folder)
    folder.parent.mkdir(parents=True, exist_ok=True)
    own = partial_path(folder)
    made = own.with_name(f"{own.stem}.{secrets.token_hex(4)}{own.suffix}")
    made.mkdir()
    mode = stat.S_IMODE(made.stat().st_mode)
    try:
        yield made
        for path in made.rglob("*"):
            if not path.is_symlink():
                path.chmod(mode if path.is_dir() else mode & 0o666)
        install_folder(made, folder, is_wanted)
    finally:
        shutil.rmtree(made, ignore_errors=True)


@contextmanager
def file_lock(lock: Path, otherwise: str) -> Iterator[None]:
    """What `lock` stands for, for this process alone as long as the block lasts.

    Raises InputError, which says `otherwise`, where another process holds it.
    """
    try:
        held = FileLock(lock).acquire(timeout=0)
    except Timeout:
        raise InputError(otherwise) from None
    with held:
        yield


def install_folder(made: Path, folder: Path, is_wanted: Callable[[Path], bool]) -> None:
    """Let what was `made` become `folder`, on the same file system, once it is on the disk.

    What lay there is replaced, unless it is what is wanted: then another writer has come first, and
    its folder stays, so that no reader is disturbed. Whenever this process is
    killed, the folder is there whole, as it was or as it is now, or not at all.
    """
    for path in (*made.rglob("*"), made):
        _sync(path)
    with FileLock(folder.parent / ".lock"):
        if is_wanted(folder):
            return
        replaced = partial_path(folder.with_name(folder.name + _REPLACED))
        if folder.exists():
            shutil.rmtree(replaced, ignore_errors=True)  # of an earlier process of the same number
            folder.rename(replaced)
        made.rename(folder)
        _sync(folder.parent)
    shutil.rmtree(replaced, ignore_errors=True)


def remove_leftovers(folder: Path, of: str = "") -> None:
    """Remove what killed writers have left in a folder (`partial_path`), which need not exist.

    With `of`, only what was to become the file or folder of that name. What another process that
    lives still writes is left alone; of one on another machine it is removed after a day. This
    process must not be writing there.
    """
    for path in folder.glob(".*.tmp"):
        partial = _PARTIAL.fullmatch(path.name)
        if partial is None or _is_being_written(path, partial):
            continue
        if of and partial["name"].removesuffix(_REPLACED) != of:
            continue
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)  # another process may be removing it too
        else:
            path.unlink(missing_ok=True)


def _is_being_written(path: Path, partial: re.Match[str]) -> bool:
    """Whether its writer may be alive; what vanishes meanwhile is one's who is."""
    if partial["pid"] == str(os.getpid()):
        return False
    if partial["host"] != _host():
        try:
            newest = max(p.stat().st_mtime for p in (path, *path.rglob("*")))
        except FileNotFoundError:
            return True
        return time.time() - newest < _ABANDONED_S
    try:
        os.kill(int(partial["pid"]), 0)
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
