"""CO3D's own lists of what is for training and what is for testing."""

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from extrap_train.data.json_files import read_json, require_dict
from extrap_train.data.paths import check_relative
from extrap_train.errors import InputError


class FrameId(NamedTuple):
    """An entry of a set list."""

    sequence: str
    number: int
    path: str


@dataclass(frozen=True)
class SequenceSplit:
    """Which sequences of a category a set list is for; no sequence is in both."""

    train: frozenset[str]
    test: frozenset[str]


def read_sequence_split(root: Path, category: str, name: str) -> SequenceSplit:
    """The sequences of a set list's `train` and `test`; those of `val` alone are in neither.

    Raises InputError where it holds no sequence out: the many-view lists of the second release
    divide the frames of one.
    """
    subsets = read_set_list(root, category, name)
    train, test = (
        frozenset(frame.sequence for frame in subsets.get(subset, ()))
        for subset in ("train", "test")
    )
    advice = (
        "give data.set_list one that divides sequences, as fewview_dev, or leave it out: then "
        "data.test_sequences of them are held out, or frames of a lone one"
    )
    if shared := sorted(train & test):
        raise InputError(
            f"{_file(root, category, name)}: divides the frames of a sequence ({shared[0]}), not "
            f"the sequences; {advice}"
        )
    if not train or not test:
        missing = "test" if train else "train"
        raise InputError(f"{_file(root, category, name)}: its list {missing!r} is empty; {advice}")
    return SequenceSplit(train, test)


def read_set_list(root: Path, category: str, name: str) -> dict[str, list[FrameId]]:
    """The subsets (`train`, `val`, `test`) of a set list, e.g. `fewview_dev`."""
    file = _file(root, category, name)
    if not file.is_file():
        known = sorted(f.stem.removeprefix("set_lists_") for f in file.parent.glob("set_lists_*"))
        raise InputError(f"{file}: no such set list; known: {', '.join(known) or 'none'}")
    content = require_dict(read_json(file), "an object with a list per subset", file)
    try:
        return {
            subset: [
                FrameId(str(sequence), int(number), check_relative(path, file))
                for sequence, number, path in entries
            ]
            for subset, entries in content.items()
        }
    except (TypeError, ValueError, OverflowError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(
            f"{file}: entries must be [sequence, frame number, path] ({error}); check the file"
        ) from None


def _file(root: Path, category: str, name: str) -> Path:
    return root / category / "set_lists" / f"set_lists_{check_relative(name, root)}.json"
