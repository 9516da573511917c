"""A run goes on with the data that it was begun with, or says why it cannot."""

from dataclasses import replace
from pathlib import Path

import pytest
from orbits import capture, even, ring
from prepared import prepared_captures

from extrap_train.data.sequences import Sequence
from extrap_train.errors import InputError
from extrap_train.runs import RunFolder
from extrap_train.trained_on import TrainedOn


def trained_on(folder: Path, sequences: list[Sequence], test_names: set[str]) -> TrainedOn:
    prepared = prepared_captures(folder, sequences, test_names)
    return TrainedOn.of(["cup"], [prepared])


@pytest.fixture
def sequences(tmp_path: Path) -> list[Sequence]:
    """Each of whose frames has a file, of which only the stamp is looked at."""
    made = []
    for index in range(4):
        one = capture(ring(even(24)), f"{index:04d}")
        file = tmp_path / f"{one.name}.jpg"
        file.write_bytes(b"photograph")
        made.append(replace(one, frames=tuple(replace(f, files=(file,)) for f in one.frames)))
    return made


@pytest.fixture
def begun(tmp_path: Path, sequences: list[Sequence]) -> RunFolder:
    """A run that says what it is trained on."""
    run = RunFolder(tmp_path / "run")
    run.path.mkdir()
    trained_on(tmp_path / "cup", sequences, {"0000"}).write(run.data)
    return run


def test_what_a_run_is_trained_on_stands_beside_it(begun: RunFolder) -> None:
    cup = TrainedOn.read(begun.data).categories["cup"]
    assert (cup.source, cup.test, cup.train) == ("co3d", ("0000",), ("0001", "0002", "0003"))


def test_the_same_data_go_on_wherever_they_lie(
    begun: RunFolder, sequences: list[Sequence], tmp_path: Path
) -> None:
    (tmp_path / "0002.jpg").touch()  # a copy has times of its own
    trained_on(tmp_path / "moved" / "cup", sequences, {"0000"}).require_same(begun.data)


def test_changed_photographs_are_refused(
    begun: RunFolder, sequences: list[Sequence], tmp_path: Path
) -> None:
    (tmp_path / "0002.jpg").write_bytes(b"another photograph")
    again = trained_on(tmp_path / "cup", sequences, {"0000"})
    with pytest.raises(InputError, match=r"changed.*: cup \(other photographs.*resume=false"):
        again.require_same(begun.data)


def test_a_split_made_anew_is_refused(
    begun: RunFolder, sequences: list[Sequence], tmp_path: Path
) -> None:
    """Else what is tested on would be what was trained on."""
    again = trained_on(tmp_path / "cup", sequences, {"0001"})
    with pytest.raises(InputError, match=r"cup \(another split, 2 .* changed sides: 0000\)"):
        again.require_same(begun.data)


def test_a_run_from_before_there_was_such_a_file_says_so(begun: RunFolder) -> None:
    again = TrainedOn.read(begun.data)
    begun.data.unlink()
    with pytest.raises(InputError, match=r"begun before runs noted .* run=NAME, or resume=false"):
        again.require_same(begun.data)


@pytest.mark.parametrize("content", [b"[]", b"{", b'{"cup": {}}', b'{"cup": 3}', b'{"cup": []}'])
def test_a_damaged_record_is_one_line(begun: RunFolder, content: bytes) -> None:
    again = TrainedOn.read(begun.data)
    begun.data.write_bytes(content)
    with pytest.raises(InputError, match=r"data\.json"):
        again.require_same(begun.data)
