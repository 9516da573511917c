"""The files of a table's results: what each holds, and how it is read. Results come from elsewhere,
too: every entry is checked, and names in them lead to no other folder.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import AfterValidator, Field

from benchmarks.protocol import Draw
from extrap_train.config import MethodConfig, TableConfig
from extrap_train.config.options import MISSING
from extrap_train.errors import InputError
from extrap_train.store.records import read_record

OK: Final = "ok"
FAILED: Final = "failed"
UNAVAILABLE: Final = "unavailable"
MADE: Final = "made"
"""`MADE`: its images are there and have not been scored yet."""
SCENE_FORMAT: Literal[3] = 3
_MOST_BYTES = 2**30
"""Of one file of a cell or scene."""


def _file_name(value: str) -> str:
    if Path(value).name != value or value in ("", "..") or "\0" in value:
        raise ValueError("must be the name of a file")
    return value


def _inner_path(value: str) -> str:
    for part in value.split("/"):
        _file_name(part)
    return value


def _all_different(values: list[str]) -> list[str]:
    if len(set(values)) < len(values):
        raise ValueError("must not hold an entry twice")
    return values


FileName = Annotated[str, AfterValidator(_file_name)]
Number = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Three, Four = Field(min_length=3, max_length=3), Field(min_length=4, max_length=4)
Pose = Annotated[list[Annotated[list[Number], Four]], Four]
Lens = Annotated[list[Annotated[list[Number], Three]], Three]


@dataclass(frozen=True)
class Score:
    """A metric's mean over a cell's targets; None where it has none, and why."""

    value: Number | None
    reason: str = ""
    per_image: list[Number | None] = field(default_factory=list)
    """By target, where the metric is one of single images."""


@dataclass(frozen=True)
class Measured:
    """What a cell's record keeps of the making of its images, apart from their files."""

    seconds: Positive
    wall_seconds: Positive
    peak_memory_mib: Positive | None
    given: dict[str, str]
    counts: dict[str, Number]


@dataclass(frozen=True)
class Hashes:
    """All that decides a cell."""

    protocol: str
    rules: str
    data: str
    device: str
    method: str
    code: str
    weights: str
    images: str
    """Of what decides the images."""
    scoring: str


@dataclass(frozen=True)
class Cell:
    """A cell's record, `cell.json`."""

    key: FileName
    method: str
    options: dict[str, Any]
    category: str
    sequence: str
    n_views: int
    draw: str
    seed: int
    scene: FileName
    device: str
    hashes: Hashes
    status: Literal["ok", "failed", "unavailable", "made"]
    reason: str = ""
    traceback: str = ""
    versions: dict[str, str] = field(default_factory=dict)
    seconds: Positive = 0.0
    wall_seconds: Positive = 0.0
    peak_memory_mib: Positive | None = None
    given: dict[str, str] = field(default_factory=dict)
    counts: dict[str, Number] = field(default_factory=dict)
    truths_apart: bool = False
    """Whether no truth was on the disk or in the method's process while it ran."""
    scoring_seconds: Positive | None = None
    metrics: dict[str, Score] = field(default_factory=dict)
    images: dict[FileName, str] = field(default_factory=dict)
    """SHA-256 by file, in the order of the targets."""
    points: dict[FileName, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Plan:
    """What a table was when it was last run, `plan.json`: what reports and verification ask."""

    table: TableConfig
    quick: bool
    protocol: str
    networks: dict[str, str]
    """SHA-256 of the weights that judged, by column."""
    methods: dict[str, MethodConfig]
    cells: Annotated[list[FileName], AfterValidator(_all_different)]


@dataclass(frozen=True)
class CameraRecord:
    """One camera of a scene."""

    world_to_cam: Pose
    intrinsics: Lens


@dataclass(frozen=True)
class Cameras:
    """Those of the inputs, at the targets' size, and of the targets."""

    inputs: list[CameraRecord]
    targets: list[CameraRecord]


Side = Annotated[int, Field(ge=1, le=8192)]


@dataclass(frozen=True)
class SceneRecord:
    """A prepared draw, `scene.json`."""

    format: Literal[3]
    origin: str
    """Names all that decides the content."""
    draw: Draw
    image_size: Side
    fine_size: Side
    depth_seconds: Positive
    cameras: Cameras
    angles_rad: list[Number]
    files: dict[Annotated[str, AfterValidator(_inner_path)], str]
    """SHA-256 by file, of the truth's, too."""


def plain(record: Any) -> Any:
    """A record as JSON holds it."""
    return json.loads(json.dumps(asdict(record), allow_nan=False))


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
        of, planned = cell.hashes.protocol, plan.protocol
        if of != planned:
            raise InputError(
                f"{folder / key}: is a result of another protocol ({of[:12]}, the table's is "
                f"{planned[:12]}); remove it"
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


def sha256_of(file: Path) -> str | None:
    """Of a file's content; None where there is no such file, or one larger than any of ours."""
    if not _is_usual(file):
        return None
    with file.open("rb") as content:
        return hashlib.file_digest(content, "sha256").hexdigest()


def read_limited(file: Path) -> bytes:
    """A file's content; raises InputError where it is missing or larger than any of ours."""
    if not _is_usual(file):
        raise InputError(f"{file}: is missing, or larger than any such file; restore it")
    return file.read_bytes()


def _is_usual(file: Path) -> bool:
    return file.is_file() and file.stat().st_size <= _MOST_BYTES
