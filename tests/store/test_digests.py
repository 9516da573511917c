"""A digest is that of the content now, whether or not it was computed before."""

import hashlib
import os
from pathlib import Path

import pytest

from extrap_train.errors import InputError
from extrap_train.store import digests
from extrap_train.store.digests import file_digest, files_below, folder_digest


@pytest.fixture
def kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Every file counts as large and settled; records go into a cache of the test's own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(digests, "_LARGE_BYTES", 1)
    monkeypatch.setattr(digests, "_SETTLED_NS", -1)
    return tmp_path / "cache"


def _sha(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def test_a_known_file_is_not_read_again(
    kept: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "weights"
    file.write_bytes(b"one")
    assert file_digest(file) == _sha(b"one")
    monkeypatch.setattr(digests, "_hash_file", lambda _: pytest.fail("was read again"))
    assert file_digest(file) == _sha(b"one")


def test_a_file_that_changed_is_read_again_even_with_its_old_time_and_size(
    kept: Path, tmp_path: Path
) -> None:
    file = tmp_path / "weights"
    file.write_bytes(b"one")
    before = file.stat()
    assert file_digest(file) == _sha(b"one")
    file.write_bytes(b"two")
    os.utime(file, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert file_digest(file) == _sha(b"two")
    other = tmp_path / "other"
    other.write_bytes(b"six")
    os.utime(other, ns=(before.st_atime_ns, before.st_mtime_ns))
    other.replace(file)
    assert file_digest(file) == _sha(b"six")


def test_a_file_that_changes_again_and_again_has_one_record(kept: Path, tmp_path: Path) -> None:
    for name in ("weights", "other"):
        for content in (b"one", b"two, longer", b"three, longer still"):
            (tmp_path / name).write_bytes(content)
            assert file_digest(tmp_path / name) == _sha(content)
    assert len([path for path in kept.rglob("*") if path.is_file()]) == 2


@pytest.mark.parametrize("damage", [b"", b"\xff" * 64, b"0" * 63])
def test_a_damaged_record_costs_only_time(kept: Path, tmp_path: Path, damage: bytes) -> None:
    file = tmp_path / "weights"
    file.write_bytes(b"one")
    file_digest(file)
    (record,) = (path for path in kept.rglob("*") if path.is_file())
    record.write_bytes(damage)
    assert file_digest(file) == _sha(b"one")


def test_a_cache_that_cannot_be_written_costs_only_time(kept: Path, tmp_path: Path) -> None:
    kept.touch()
    file = tmp_path / "weights"
    file.write_bytes(b"one")
    assert file_digest(file) == _sha(b"one")


def test_a_file_that_has_just_changed_is_not_remembered(
    kept: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(digests, "_SETTLED_NS", 10**12)
    file = tmp_path / "weights"
    file.write_bytes(b"one")
    file_digest(file)
    assert not kept.exists()


def test_a_folder_is_its_names_and_contents(tmp_path: Path) -> None:
    for name in ("a", "b", "c", "d"):
        (tmp_path / name / "unet").mkdir(parents=True)
        (tmp_path / name / "unet" / "weights").write_bytes(b"one")
    (tmp_path / "b" / "unet" / "weights").write_bytes(b"two")
    (tmp_path / "c" / "unet" / "weights").rename(tmp_path / "c" / "weights")
    found = {name: folder_digest(tmp_path / name) for name in ("a", "b", "c", "d")}
    assert found["a"] == found["d"]
    assert len({found[name] for name in ("a", "b", "c")}) == 3


@pytest.mark.parametrize("name", ["unet", "vae/deep", "weights"])
def test_a_folder_is_also_what_its_links_lead_to(tmp_path: Path, name: str) -> None:
    linked, copied = tmp_path / "linked" / name, tmp_path / "copied" / name
    for folder in (tmp_path / "elsewhere", copied):
        folder.mkdir(parents=True)
        (folder / "weights").write_bytes(b"one")
    linked.parent.mkdir(parents=True)
    linked.symlink_to(tmp_path / "elsewhere")
    before = folder_digest(tmp_path / "linked")
    assert before == folder_digest(tmp_path / "copied")
    (tmp_path / "elsewhere" / "weights").write_bytes(b"two")
    assert folder_digest(tmp_path / "linked") != before


def test_links_that_lead_in_circles_end(tmp_path: Path) -> None:
    for name, other in (("a", "b"), ("b", "a")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "weights").touch()
        (tmp_path / name / "other").symlink_to(tmp_path / other)
    (tmp_path / "a" / "self").symlink_to(tmp_path / "a")
    found = [path.relative_to(tmp_path / "a").as_posix() for path in files_below(tmp_path / "a")]
    assert found == ["other/weights", "weights"]


def test_what_is_no_file_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="absent"):
        file_digest(tmp_path / "absent")
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="pipe"):
        file_digest(tmp_path / "pipe")
