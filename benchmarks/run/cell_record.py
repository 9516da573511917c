"""The records of a table's results, and how they are read. Results come from elsewhere, too: every
entry is checked, and names in them lead to no other folder.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Final, Literal

from pydantic import AfterValidator

from benchmarks.protocol.array_files import FileName, Number, Positive, read_limited, sha256_of
from benchmarks.score import Score
from extrap_train.config import MethodConfig, TableConfig
from extrap_train.config.options import MISSING
from extrap_train.errors import InputError
from extrap_train.store.manifest import Manifest
from extrap_train.store.records import read_record

OK: Final = "ok"
FAILED: Final = "failed"
UNAVAILABLE: Final = "unavailable"
MADE: Final = "made"
"""`MADE`: its images are there and have not been scored yet."""
MAX_LETTERS = 300


def one_line(text: str, most: int = MAX_LETTERS) -> str:
    """Text on one line, without control characters and lone surrogates, cut to `most` letters."""
    line = " ".join(text.split())
    if len(line) > most:
        line = line[: most - 1] + "…"
    return "".join(one if one.isprintable() else "\N{REPLACEMENT CHARACTER}" for one in line)


def _all_different(values: list[str]) -> list[str]:
    if len(set(values)) < len(values):
        raise ValueError("must not hold an entry twice")
    return values


@dataclass(frozen=True, kw_only=True)
class MethodOutput:
    """What became of a method's work; everything after `traceback` is of images that were made."""

    status: Literal["ok", "failed", "unavailable", "made"]
    reason: str = ""
    traceback: str = ""
    seconds: Positive = 0.0
    wall_seconds: Positive = 0.0
    peak_memory_mib: Positive | None = None
    given: dict[str, str] = field(default_factory=dict)
    counts: dict[str, Number] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Cell(MethodOutput):
    """A cell's record, `cell.json`."""

    key: FileName
    method: str
    category: str
    sequence: str
    n_views: int
    draw: str
    seed: int
    scene: FileName
    protocol: str
    made_from: Manifest
    scored_from: Manifest
    truths_apart: bool = False
    """Whether no truth was on the disk or in the method's process while it ran."""
    scoring_seconds: Positive | None = None
    metrics: dict[str, Score] = field(default_factory=dict)
    images: dict[FileName, str] = field(default_factory=dict)
    """SHA-256 by file, in the order of the targets."""
    points: dict[FileName, str] = field(default_factory=dict)

    @property
    def device(self) -> str:
        """Where its images were made."""
        return str(self.made_from.options.get("device", "unknown"))


@dataclass(frozen=True)
class Plan:
    """What a table was when it was last run, `plan.json`: what reports and verification ask."""

    table: TableConfig
    quick: bool
    protocol: str
    scored_from: Manifest
    methods: dict[str, MethodConfig]
    cells: Annotated[list[FileName], AfterValidator(_all_different)]


def read_cell(folder: Path) -> Cell | None:
    """A cell's record; None where there is none. Raises InputError where it, or a file that it
    names, is damaged.
    """
    file = folder / "cell.json"
    if not file.is_file():
        return None
    cell = read_record(file, Cell, "delete it and run the table again")
    if cell.key != folder.name:
        raise InputError(f"{file}: is the record of the cell {cell.key}; delete it")
    if cell.status in (OK, MADE) and not cell.images:
        raise InputError(f"{file}: names no images; delete it and run the table again")
    for name, stated in (cell.images | cell.points).items():
        if sha256_of(folder / name) != stated:
            raise InputError(f"{folder / name}: is missing, or not what its cell's hash says")
    return cell


def read_plan(file: Path) -> Plan:
    """What a table was when it was last run; raises InputError where that is damaged."""
    plan = read_record(file, Plan, "run the table again")
    name, factories = plan.table.name, [method.factory for method in plan.methods.values()]
    if MISSING in (name, *factories) or Path(name).name != name or "\0" in name:
        raise InputError(
            f"{file}: does not say what made its rows, or names no folder; run the table again"
        )
    return plan


def planned_cells(folder: Path, plan: Plan) -> list[Cell]:
    """The records of a plan's cells, without those that are missing or not scored yet.

    Raises InputError where one is damaged, of another protocol or of no row.
    """
    cells = []
    for key in plan.cells:
        cell = read_cell(folder / key)
        if cell is None or cell.status == MADE:
            continue
        if cell.protocol != plan.protocol:
            raise InputError(
                f"{folder / key}: is a result of another protocol ({cell.protocol[:12]}, the "
                f"table's is {plan.protocol[:12]}); remove it"
            )
        if cell.method not in plan.methods:
            raise InputError(
                f"{folder / key}: is of {cell.method}, and the table has no such row; remove it"
            )
        cells.append(cell)
    return cells


def files_of(folder: Path, stated: Mapping[str, str]) -> dict[str, bytes]:
    """The contents of a finished cell's images or points, by name."""
    return {name: read_limited(folder / name) for name in stated}
