"""Captures as zip archives: unpacked once, whole or not at all, and never outside the cache."""

import stat
import zipfile
from pathlib import Path

import pytest
import torch
from captures import view_at
from complaints import complaint_about
from posed_folders import write_transforms

from extrap_train.data.archives import unpack_archive
from extrap_train.data.scene_spec import open_scene
from extrap_train.errors import InputError


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache/extrap-train/captures"


@pytest.fixture
def folder(tmp_path):
    write_transforms(tmp_path / "garden", [view_at(0), view_at(30)])
    return tmp_path / "garden"


def pack(folder, archive, below=""):
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as packed:
        for path in sorted(folder.rglob("*")):
            packed.write(path, Path(below) / path.relative_to(folder))
    return archive


def pack_texts(archive, *members):
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as packed:
        for name, content in members:
            packed.writestr(name, content)
    return archive


@pytest.mark.parametrize("below", ["", "export/my garden"])
@pytest.mark.parametrize("name", ["visit.zip", "visit.R3D"])
def test_an_archive_reads_as_its_folder(tmp_path, folder, below, name):
    archive = pack(folder, tmp_path / name, below)
    with zipfile.ZipFile(archive, "a") as packed:  # as macOS adds
        packed.writestr("__MACOSX/._garden", "x")
        packed.writestr(".DS_Store", "x")
    packed, plain = open_scene(str(archive)), open_scene(str(folder))
    assert packed.name == "visit"
    assert [frame.name for frame in packed.frames] == [frame.name for frame in plain.frames]
    for one, other in zip(packed.frames, plain.frames, strict=True):
        assert torch.equal(one.camera.world_to_cam, other.camera.world_to_cam)
        assert torch.equal(one.load().image, other.load().image)


def test_it_is_unpacked_once_and_again_if_a_file_is_missing(tmp_path, folder):
    archive = pack(folder, tmp_path / "visit.zip")
    unpacked = unpack_archive(archive)
    before = unpacked.stat().st_ino
    assert unpack_archive(archive) == unpacked
    assert unpacked.stat().st_ino == before
    (unpacked / "transforms.json").unlink()
    assert (unpack_archive(archive) / "transforms.json").is_file()


def test_other_content_of_the_same_name_is_unpacked_elsewhere(tmp_path, folder):
    first = unpack_archive(pack(folder, tmp_path / "visit.zip"))
    (folder / "notes.txt").write_text("more")
    assert unpack_archive(pack(folder, tmp_path / "visit.zip")) != first


def test_a_folder_that_belongs_to_captures_is_not_entered(tmp_path):
    unpacked = unpack_archive(pack_texts(tmp_path / "a.zip", ("images/a.txt", "x")))
    assert (unpacked / "images").is_dir()


def typed(name, kind):
    info = zipfile.ZipInfo(name)
    info.external_attr = (kind | 0o777) << 16
    return info


@pytest.mark.filterwarnings("ignore:Duplicate name")
@pytest.mark.parametrize(
    "names",
    [
        ["/etc/passwd"],
        ["../outside"],
        ["a/../../outside"],
        ["a\\..\\..\\outside"],
        ["C:\\outside"],
        [typed("link", stat.S_IFLNK)],
        [typed("pipe", stat.S_IFIFO)],
        ["a", "a"],
        ["a/b", "./a/b"],
        ["a", "a/b"],
        ["a" * 300],
        ["bell\a"],
        ["."],
    ],
    ids=str,
)
def test_hostile_names_unpack_nothing(tmp_path, cache, names):
    members = [("first.txt", "x"), *((name, "/etc/passwd") for name in names)]
    complaint_about(unpack_archive, pack_texts(tmp_path / "a.zip", *members))
    assert not cache.exists()
    assert not list(tmp_path.rglob("outside"))


def test_a_bomb_is_refused_before_it_is_unpacked(tmp_path, cache):
    archive = pack_texts(tmp_path / "a.zip", ("zeros", bytes(64 * 2**20)))
    complaint_about(unpack_archive, archive)
    assert not cache.exists()


def test_too_many_files_are_refused(tmp_path, cache, monkeypatch):
    monkeypatch.setattr("extrap_train.data.archives.MAX_FILES", 2)
    archive = pack_texts(tmp_path / "a.zip", *((str(i), "x") for i in range(3)))
    complaint_about(unpack_archive, archive)
    assert not cache.exists()


def test_an_encrypted_archive_is_refused(tmp_path):
    content = bytearray(pack_texts(tmp_path / "a.zip", ("a", "x")).read_bytes())
    content[content.index(b"PK\x01\x02") + 8] |= 1
    (tmp_path / "a.zip").write_bytes(content)
    assert "encrypted" in complaint_about(unpack_archive, tmp_path / "a.zip")


def test_a_damaged_archive_leaves_nothing(tmp_path, cache, folder):
    """Wherever it is cut, and whatever byte is wrong: whole content, or one line and no folder."""
    whole = pack(folder, tmp_path / "a.zip").read_bytes()
    places = range(0, len(whole), len(whole) // 60)
    damaged = [whole[: len(whole) * part // 8] for part in range(8)]
    damaged += [whole[:at] + bytes([whole[at] ^ 0xFF]) + whole[at + 1 :] for at in places]
    refusals = [said for content in damaged if (said := refusal(tmp_path / "b.zip", content))]
    assert len(refusals) > 40
    assert all(said.startswith(str(tmp_path / "b.zip")) for said in refusals)
    assert not any("\n" in said for said in refusals)
    assert not list(cache.glob(".*.tmp"))
    unpacked = {path for path in cache.glob("b-*") if path.is_dir()}
    assert all((path / "transforms.json").is_file() for path in unpacked)


@pytest.mark.parametrize("offset", [1, 2**31, 2**32 - 2])
def test_a_file_that_lies_nowhere_is_damage_and_no_full_disk(tmp_path, cache, offset):
    """The offset of the only file, or of the list of files, from which the former is counted."""
    content = pack_texts(tmp_path / "a.zip", ("a", "x")).read_bytes()
    for place in (content.index(b"PK\x01\x02") + 42, content.index(b"PK\x05\x06") + 16):
        damaged = content[:place] + offset.to_bytes(4, "little") + content[place + 4 :]
        (tmp_path / "a.zip").write_bytes(damaged)
        said = complaint_about(unpack_archive, tmp_path / "a.zip")
        assert "damaged" in said
        assert "XDG_CACHE_HOME" not in said


def refusal(archive, content):
    """What is said of an archive's content, None where it can be unpacked."""
    archive.write_bytes(content)
    try:
        unpack_archive(archive)
    except InputError as error:
        return str(error)
    return None


def test_a_full_disk_is_named(tmp_path, folder, monkeypatch):
    monkeypatch.setattr("shutil.disk_usage", lambda path: type("U", (), {"free": 10})())
    said = complaint_about(unpack_archive, pack(folder, tmp_path / "a.zip"))
    assert "XDG_CACHE_HOME" in said
