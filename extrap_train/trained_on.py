"""What a run is trained on, beside its configuration: the data may change while that stays."""

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path

from extrap_train.data.json_files import read_json
from extrap_train.data.prepared import PreparedData
from extrap_train.data.validation import require_dict
from extrap_train.errors import InputError
from extrap_train.store.atomic import write_atomic

TRAINED_ON = "data.json"
"""In a run's folder, beside its model; beside the packaged models likewise."""
START_OVER = "choose another run=NAME, or resume=false to start over"
"""What to do with a run that cannot go on."""


@dataclass(frozen=True)
class CategoryData:
    """One member category as it was prepared for a run."""

    source: str
    """`synthetic` or `co3d`."""
    key: str
    """Of captures and options, the same on every machine (the preparation's manifest)."""
    split: str
    """Hash of what is trained on and what is tested on."""
    train: tuple[str, ...]
    """Sequences whose frames are trained on, but for those held out; no category."""
    test: tuple[str, ...]
    """Sequences that are for testing alone."""
    seed: int | None = field(default=None, compare=False)
    """Of rendered captures, whose names say nothing without it (it is part of the key); None of
    others, and where a record is older than this entry.
    """

    @classmethod
    def of(cls, prepared: PreparedData) -> "CategoryData":
        """As it lies prepared."""
        names = {
            tested: sorted(
                name.split("/", 1)[1]
                for name, role in prepared.roles.items()
                if (role == "test") is tested
            )
            for tested in (False, True)
        }
        manifest = prepared.manifest
        data = manifest["data"] or {}
        return cls(
            source=data.get("name", ""),
            key=manifest["key"],
            split=manifest["split"],
            train=tuple(names[False]),
            test=tuple(names[True]),
            seed=data.get("seed"),
        )

    def seen_by(self, other: "CategoryData") -> list[str]:
        """Which of what is for testing here was trained on there, the category being the same.

        Rendered captures of two seeds are others, whatever they are called; where one is not noted,
        they count as the same.
        """
        differ = None not in (self.seed, other.seed) and self.seed != other.seed
        if differ or self.source != other.source:
            return []
        return sorted({*self.test} & {*other.train})


@dataclass(frozen=True)
class TrainedOn:
    """The categories of a run, by name."""

    categories: Mapping[str, CategoryData]

    @classmethod
    def of(cls, members: Iterable[str], prepared: Iterable[PreparedData]) -> "TrainedOn":
        """The member categories as they lie prepared."""
        pairs = zip(members, prepared, strict=True)
        return cls({member: CategoryData.of(data) for member, data in pairs})

    @classmethod
    def read(cls, file: Path) -> "TrainedOn":
        """What `write` wrote; InputError where that is damaged."""
        content = require_dict(read_json(file), "an object with a category each", file)
        try:
            return cls(
                {
                    name: CategoryData(
                        **{**entry, "train": tuple(entry["train"]), "test": tuple(entry["test"])}
                    )
                    for name, entry in content.items()
                }
            )
        except (TypeError, KeyError) as error:
            raise InputError(
                f"{file}: says not what the run was trained on ({error}); restore it, or choose "
                "another run=NAME"
            ) from None

    def write(self, file: Path) -> None:
        """As JSON, whole or not at all."""
        content = {name: asdict(data) for name, data in self.categories.items()}
        write_atomic(file, (json.dumps(content, indent=1) + "\n").encode())

    def require_same(self, file: Path, otherwise: str = START_OVER) -> None:
        """InputError unless a run was trained on the same, as `file` says.

        `otherwise` is what remains to be done where the data cannot be put back.
        """
        if not file.is_file():
            raise InputError(
                f"{file.parent}: was begun before runs noted what they are trained on ({file.name} "
                f"is missing), so nobody can tell whether the data are still the same: {otherwise}"
            )
        before = TrainedOn.read(file).categories
        changed = [
            f"{name} ({_difference(before.get(name), data)})"
            for name, data in self.categories.items()
            if before.get(name) != data
        ]
        if changed:
            raise InputError(
                f"{file.parent}: its data have changed since it was begun: {', '.join(changed)}; "
                f"put them and their options back as they were, or {otherwise}"
            )


def _difference(before: CategoryData | None, now: CategoryData) -> str:
    if before is None:
        return "it was no member"
    if before.split != now.split:
        fresh = sorted({*before.test} & {*now.train} | {*before.train} & {*now.test})
        moved = f", {len(fresh)} sequences have changed sides: {fresh[0]}" if fresh else ""
        return f"another split{moved}"
    return "other photographs, cameras or preparation"
