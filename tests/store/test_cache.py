"""A result's folder is made, reused or refused, and belongs to one process at a time."""

import multiprocessing
import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from extrap_train.errors import InputError
from extrap_train.store.atomic import partial_path
from extrap_train.store.manifest import MANIFEST, Conflict, Manifest, claim, read_manifest

_ONE = Manifest.of({"seed": 0}, {"photograph": "aa"})
_OTHERS = [
    Manifest.of({"seed": 1}, {"photograph": "aa"}),
    Manifest.of({"seed": 0}, {"photograph": "bb"}),
    Manifest.of({"seed": 0}),
]


@pytest.fixture
def made(tmp_path: Path) -> Path:
    folder = tmp_path / "view" / "scene"
    with claim(folder, _ONE, resume=True) as claimed, claimed.replace() as new:
        assert not claimed.is_reused
        (new / "picture").write_text("one")
    return folder


def test_the_same_result_is_reused(made: Path) -> None:
    with claim(made, _ONE, resume=True) as claimed:
        assert claimed.is_reused
    assert read_manifest(made) == _ONE


@pytest.mark.parametrize("other", _OTHERS)
def test_another_result_is_refused_and_the_first_one_stays(made: Path, other: Manifest) -> None:
    with pytest.raises(Conflict, match=r"run=NAME.*resume=false"), claim(made, other, resume=True):
        pass
    assert (made / "picture").read_text() == "one"
    with claim(made, other, resume=False) as claimed:
        assert not claimed.is_reused
        claimed.begin()
    assert [path.name for path in made.iterdir()] == [MANIFEST]
    assert read_manifest(made) == other


@pytest.mark.parametrize(
    "damage",
    [
        lambda file: file.unlink(),
        lambda file: file.write_text("[" * 20_000),
        lambda file: file.write_text('{"options": {}, "inputs": {"a": 3}}'),
        lambda file: file.write_bytes(b"\xff\x00"),
        lambda file: file.write_text("{}"),
    ],
)
def test_a_result_that_does_not_say_what_it_is_is_refused(
    made: Path, damage: Callable[[Path], object]
) -> None:
    """Not even `resume=false` replaces it: nobody knows whose it is."""
    damage(made / MANIFEST)
    for resume in (True, False):
        with (
            pytest.raises(InputError, match=r"manifest\.json.* run= or output="),
            claim(made, _ONE, resume=resume),
        ):
            pass
    assert (made / "picture").exists()


def _in_a_file(place: Path) -> None:
    place.write_text("years of work")


def _in_a_folder(place: Path) -> None:
    place.mkdir()
    (place / "thesis.txt").write_text("years of work")


def _under_a_leftovers_name(place: Path) -> None:
    place.mkdir()
    partial_path(place / "thesis").write_text("years of work")


def _in_a_folder_below(place: Path) -> None:
    (place / "chapters").mkdir(parents=True)


def _beside_a_foreign_manifest(place: Path) -> None:
    _in_a_folder(place)
    (place / MANIFEST).write_text('{"name": "an extension of a browser", "manifest_version": 3}')


def _in_a_link_to_itself(place: Path) -> None:
    place.symlink_to(place)


@pytest.mark.parametrize("resume", [True, False])
@pytest.mark.parametrize("is_linked", [False, True])
@pytest.mark.parametrize(
    "keep",
    [
        _in_a_file,
        _in_a_folder,
        _under_a_leftovers_name,
        _in_a_folder_below,
        _beside_a_foreign_manifest,
        _in_a_link_to_itself,
    ],
)
def test_what_is_not_a_result_is_never_replaced(
    tmp_path: Path, keep: Callable[[Path], None], is_linked: bool, resume: bool
) -> None:
    place = folder = tmp_path / "mine"
    keep(place)
    if is_linked:
        folder = tmp_path / "view" / "scene"
        folder.parent.mkdir()
        folder.symlink_to(place)
    before = _content(tmp_path)
    with pytest.raises(InputError, match=str(folder)), claim(folder, _ONE, resume=resume):
        pass
    assert _content(tmp_path) == before


def _content(folder: Path) -> dict[Path, str]:
    """What lies below a folder, but for locks."""
    return {
        path: str(path.readlink()) if path.is_symlink() else path.read_text()
        for path in folder.rglob("*")
        if path.suffix != ".lock" and (path.is_symlink() or path.is_file())
    }


@pytest.mark.parametrize("target", ["empty", "not/there/yet", "../elsewhere"])
def test_a_link_to_a_folder_is_followed_and_stays(tmp_path: Path, target: str) -> None:
    """A user lets a result lie on another disk."""
    link, place = tmp_path / "view" / "scene", tmp_path / "view" / target
    (tmp_path / "view" / "empty").mkdir(parents=True)
    link.symlink_to(target)
    for manifest in (_ONE, _OTHERS[0]):
        with claim(link, manifest, resume=False) as claimed, claimed.replace() as new:
            (new / "picture").write_text("one")
        assert link.readlink() == Path(target)
        assert read_manifest(place) == manifest
    with claim(link, _OTHERS[0], resume=True) as claimed:
        assert claimed.is_reused


def test_beside_a_links_target_only_its_own_leftovers_are_removed(made: Path) -> None:
    link = made.parents[1] / "link"
    link.symlink_to(made)
    own, others = partial_path(made), partial_path(made.with_name("scene.2"))
    own.mkdir()
    others.mkdir()
    with claim(link, _ONE, resume=True):
        assert not own.exists()
        assert others.exists()


def test_an_interrupted_replacement_leaves_the_result_that_was_there(made: Path) -> None:

    def interrupted() -> None:
        with claim(made, _ONE, resume=False) as claimed, claimed.replace() as new:
            (new / "picture").write_text("two")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert (made / "picture").read_text() == "one"
    assert {p.name for p in made.parent.iterdir() if p.suffix != ".lock"} - {".lock"} == {"scene"}


def test_leftovers_of_killed_writers_are_swept_wherever_they_lie(made: Path) -> None:
    (made / "checkpoints").mkdir()
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        left = pool.map(partial_path, [made, made / "model", made / "checkpoints" / "step"])
        pool.close()
        pool.join()
    left[0].mkdir()
    left[1].mkdir()
    left[2].touch()
    with claim(made, _ONE, resume=True):
        assert not any(path.exists() for path in left)


def test_a_folder_that_another_process_holds_is_refused(made: Path) -> None:
    with (
        claim(made, _ONE, resume=True),
        pytest.raises(InputError, match="another process"),
        claim(made, _ONE, resume=True),
    ):
        pass


def _claim_and_be_killed(folder: Path) -> None:
    with claim(folder, _ONE, resume=True):
        os.kill(os.getpid(), signal.SIGKILL)


def test_the_command_after_a_killed_one_says_so_once(
    made: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    killed = multiprocessing.get_context("fork").Process(target=_claim_and_be_killed, args=[made])
    killed.start()
    killed.join()
    said = []
    for _ in range(2):
        with claim(made, _ONE, resume=True):
            said.append(capsys.readouterr().err)
    assert str(made) in said[0]
    assert "killed" in said[0]
    assert not said[1]
    assert (made / "picture").read_text() == "one"
