"""What is trained on and what is tested on."""

import hashlib
import json
import logging
from collections import defaultdict
from collections.abc import Collection, Sequence
from dataclasses import dataclass

from extrap_train.data.square_frames import HELD_OUT_EVERY
from extrap_train.errors import InputError

LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class SequenceSplit:
    """Sequences, as `category/name`, by what they are for."""

    train: tuple[str, ...]
    test: tuple[str, ...]
    lone: tuple[str, ...]
    """The only usable sequence of its category: trained on, with frames held out for testing."""

    def role(self, sequence: str) -> str:
        """`train`, `test` or `train and test`."""
        if sequence in self.lone:
            return "train and test"
        return "test" if sequence in self.test else "train"

    def to_json(self) -> str:
        """The split as a file's content, with a hash of it."""
        content = {
            "train": self.train,
            "test": self.test,
            "lone": {name: {"held_out_every": HELD_OUT_EVERY} for name in self.lone},
        }
        digest = hashlib.sha256(json.dumps(content).encode()).hexdigest()
        return json.dumps({**content, "sha256": digest}, indent=1) + "\n"


def split_sequences(sequences: Sequence[str], test: Collection[str] | int) -> SequenceSplit:
    """Divide every category's sequences (`category/name`).

    `test` names the test sequences (by name, or with the category), or says how many a category
    gives: those whose names have the smallest hashes, and never more than half. Raises InputError
    where nothing is left to train on.
    """
    if not isinstance(test, int):
        _warn_of_unknown(sequences, test)
    members: dict[str, list[str]] = defaultdict(list)
    for sequence in sorted(sequences):
        members[sequence.split("/", 1)[0]].append(sequence)
    tested: list[str] = []
    lone: list[str] = []
    for category, names in members.items():
        if len(names) == 1 and (isinstance(test, int) or not _match_names(names, test)):
            lone += names
        elif isinstance(test, int):
            tested += sorted(names, key=by_hash)[: min(test, len(names) // 2)]
        else:
            tested += _select_named(category, names, test)
    train = tuple(s for s in sorted(sequences) if s not in {*tested, *lone})
    return SequenceSplit(train, tuple(sorted(tested)), tuple(lone))


def _select_named(category: str, names: list[str], test: Collection[str]) -> list[str]:
    chosen = _match_names(names, test)
    if len(chosen) == len(names):
        raise InputError(
            f"{category}: all {len(names)} usable sequences are named as test sequences, none is "
            "left to train on; add sequences or name fewer"
        )
    if not chosen:
        raise InputError(
            f"{category}: none of the {len(test)} named test sequences is among the {len(names)} "
            "usable ones; name others or give their number instead"
        )
    return chosen


def _match_names(names: Collection[str], test: Collection[str]) -> list[str]:
    return [name for name in names if name in test or name.split("/", 1)[1] in test]


def _warn_of_unknown(sequences: Collection[str], test: Collection[str]) -> None:
    known = {*sequences, *(name.split("/", 1)[1] for name in sequences)}
    unknown = sorted(set(test) - known)
    if unknown:
        more = ", …" if len(unknown) > 3 else ""
        LOG.warning(
            "%d of %d named test sequences are not among the usable ones: %s%s",
            len(unknown),
            len(test),
            ", ".join(unknown[:3]),
            more,
        )


def by_hash(name: str) -> str:
    """The order in which sequences, as `category/name`, become test sequences."""
    return hashlib.sha256(name.encode()).hexdigest()
