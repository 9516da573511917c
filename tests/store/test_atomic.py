import errno
import multiprocessing
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from extrap_train.errors import InputError
from extrap_train.store.atomic import (
    atomic_file,
    atomic_folder,
    partial_path,
    remove_leftovers,
    save_array,
    write_atomic,
)


def test_writing_makes_folders_and_replaces(tmp_path):
    file = tmp_path / "deep" / "down" / "file.txt"
    write_atomic(file, b"first")
    write_atomic(file, b"second")
    assert file.read_bytes() == b"second"
    assert list(file.parent.iterdir()) == [file]


def test_a_full_disk_leaves_the_old_file_and_says_so(tmp_path, monkeypatch):
    file = tmp_path / "file.txt"
    write_atomic(file, b"old")

    def write_half(path, content):
        with path.open("wb") as stream:
            stream.write(content[: len(content) // 2])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", write_half)
    with pytest.raises(InputError, match=r"cannot be written \(No space left on device\); free"):
        write_atomic(file, b"newer")
    assert file.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [file]


def write_number(folder: Path, number: int, is_wanted=lambda there: False) -> None:
    with atomic_folder(folder, is_wanted) as made:
        (made / "number").write_text(str(number))


class Unwritable:
    def __str__(self) -> str:
        raise ValueError("half")


def test_a_folder_is_there_whole_or_not_at_all(tmp_path):
    folder = tmp_path / "deep" / "one"
    with pytest.raises(ValueError, match="half"):
        write_number(folder, Unwritable())
    assert not folder.exists()
    assert list(folder.parent.iterdir()) == []
    write_number(folder, 1)
    write_number(folder, 2)
    assert (folder / "number").read_text() == "2"
    assert {path.name for path in folder.parent.iterdir()} == {"one", ".lock"}


def test_a_folder_that_is_being_replaced_is_never_half_there(tmp_path, monkeypatch):
    folder = tmp_path / "one"
    write_number(folder, 1)
    (folder / "more").touch()

    def killed_within(path, **options):
        next(Path(path).iterdir(), folder).unlink()
        raise KeyboardInterrupt

    monkeypatch.setattr(shutil, "rmtree", killed_within)
    with pytest.raises(KeyboardInterrupt):
        write_number(folder, 2)
    seen = {path.name: path.read_text() for path in folder.iterdir()}
    assert seen in ({"number": "1", "more": ""}, {"number": "2"})
    monkeypatch.undo()
    remove_leftovers(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"one", ".lock"}


def test_who_comes_second_leaves_the_first_ones_folder(tmp_path):
    folder = tmp_path / "one"
    write_number(folder, 1)
    before = folder.stat().st_ino
    write_number(folder, 1, lambda there: (there / "number").read_text() == "1")
    assert folder.stat().st_ino == before
    assert {path.name for path in tmp_path.iterdir()} == {"one", ".lock"}


def write_many(folder: Path) -> None:
    for _ in range(30):
        write_number(folder, 1)
        write_number(folder, 1, lambda there: (there / "number").exists())


def test_processes_that_write_one_folder_do_not_collide(tmp_path):
    # Forked: they only write files, and start at once.
    context = multiprocessing.get_context("fork")
    writers = [context.Process(target=write_many, args=(tmp_path / "one",)) for _ in range(2)]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    assert [writer.exitcode for writer in writers] == [0, 0]
    assert (tmp_path / "one" / "number").read_text() == "1"


def test_only_what_nobody_writes_any_more_is_removed(tmp_path):
    users = tmp_path / ".draft.tmp"
    users.write_text("not a name that a writer of ours gives")
    living = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    own = partial_path(tmp_path / "own").name
    name = {who: own.replace(f"-{os.getpid()}.", f"-{who}.") for who in (living.pid, dead.pid)}
    elsewhere, long_ago = ".one.other_host-7.abc.tmp", ".two.other_host-7.abc.tmp"
    for folder in (own, *name.values(), elsewhere, long_ago):
        (tmp_path / folder).mkdir()
    os.utime(tmp_path / long_ago, (0, 0))
    remove_leftovers(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {users.name, name[living.pid], elsewhere}
    living.communicate()
    remove_leftovers(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {users.name, elsewhere}


@pytest.mark.parametrize(
    ("owner", "step", "is_folder"),
    [(Path, "rglob", True), (shutil, "rmtree", True), (Path, "unlink", False)],
)
def test_what_vanishes_while_it_is_cleared_away_is_no_error(
    tmp_path, monkeypatch, owner, step, is_folder
):
    """Its writer on another machine may be finishing, or another process be clearing up too."""
    folder = tmp_path / "folder"
    folder.mkdir()
    other = folder / ".one.other_host-7.abc.tmp"
    other.mkdir() if is_folder else other.touch()
    os.utime(other, (0, 0))
    really = getattr(owner, step)

    def too_late(path, *arguments, **options):
        if path == other and other.exists():
            other.rename(tmp_path / "gone")
        return really(path, *arguments, **options)

    monkeypatch.setattr(owner, step, too_late)
    remove_leftovers(folder)
    assert {path.name for path in tmp_path.iterdir()} == {"folder", "gone"}
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize("shape", [(0, 2, 3), (5,), (3, 700, 4)])
@pytest.mark.parametrize("kind", [np.uint8, np.float16, np.float32])
def test_saved_arrays_are_numpys_files_of_the_stated_size(tmp_path, shape, kind):
    array = (np.arange(np.prod(shape)) % 251).astype(kind).reshape(shape)
    size = save_array(tmp_path / "ours.npy", array)
    np.save(tmp_path / "numpys.npy", array)
    assert (tmp_path / "ours.npy").read_bytes() == (tmp_path / "numpys.npy").read_bytes()
    assert size == (tmp_path / "ours.npy").stat().st_size
    save_array(tmp_path / "turned.npy", array.T)
    np.testing.assert_array_equal(np.load(tmp_path / "turned.npy"), array.T)


@pytest.mark.parametrize("count", [1, 1000, 1_000_000])
def test_a_full_device_has_its_number_however_much_is_written(count):
    with pytest.raises(OSError) as caught:
        save_array(Path("/dev/full"), np.zeros(count, np.uint8))
    assert caught.value.errno == errno.ENOSPC


def test_a_name_is_given_only_to_what_has_reached_the_disk(tmp_path, monkeypatch):
    """Else a power cut leaves an empty file that counts as whole."""
    synced = []

    def noted(descriptor):
        synced.append((Path(f"/proc/self/fd/{descriptor}").readlink(), path.exists()))

    path = tmp_path / "whole"
    monkeypatch.setattr(os, "fsync", noted)
    write_atomic(path, b"content")
    assert synced == [(partial_path(path), False), (tmp_path, True)]


@pytest.mark.parametrize(
    ("umask", "file_mode", "folder_mode"), [(0o022, 0o644, 0o755), (0o007, 0o660, 0o770)]
)
def test_modes_follow_the_umask_whatever_writes(tmp_path, umask, file_mode, folder_mode):
    before = os.umask(umask)
    try:
        with atomic_file(tmp_path / "weights") as file:
            file.touch()
            file.chmod(0o600)
        with atomic_folder(tmp_path / "model") as folder:
            (folder / "part").mkdir(mode=0o700)
            (folder / "part" / "weights").touch(mode=0o600)
            (folder / "link").symlink_to(tmp_path / "weights")
    finally:
        os.umask(before)
    modes = {p.name: p.lstat().st_mode & 0o777 for p in tmp_path.rglob("*") if not p.is_symlink()}
    assert modes["model"] == modes["part"] == folder_mode
    assert {p.stat().st_mode & 0o777 for p in tmp_path.rglob("weights")} == {file_mode}
