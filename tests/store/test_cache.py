"""A result's folder is made, reused or refused, and belongs to one process at a time."""

import multiprocessing
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
    damage(made / MANIFEST)
    with pytest.raises(InputError, match=r"resume=false"), claim(made, _ONE, resume=True):
        pass
    assert (made / "picture").exists()


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
