"""One cell: a method on a draw. Its folder is named by all that decides the result, and is written
whole or not at all; a finished one is never changed.

<key>/cell.json, 0.png …   (the target images, in the order of the protocol's targets)

First the method makes the images, in a process of its own and without any truth (`run_method`);
its output is checked and kept. Later the images are scored. Records may come from elsewhere: every
entry is checked, and names in them lead to no other folder.
"""

import hashlib
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Final, Literal

import numpy as np
import torch
from pydantic import AfterValidator

from benchmarks.protocol.array_files import (
    FileName,
    Number,
    Positive,
    npy_bytes,
    read_limited,
    sha256_of,
)
from benchmarks.protocol.draws import Draw
from benchmarks.protocol.prepared_scene import Scene
from benchmarks.score import Score
from extrap_train.config import MethodConfig, ScoringConfig, TableConfig
from extrap_train.config.options import MISSING
from extrap_train.data.image_files import png_bytes
from extrap_train.errors import InputError
from extrap_train.store.atomic import atomic_folder
from extrap_train.store.manifest import Manifest
from extrap_train.store.records import read_record, write_record

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
    """What a table was when it was last run, `plan.json`: what reports and verification ask.

    The file is sealed (`write_sealed`), for what no cell states: titles, headings.
    """

    table: TableConfig
    quick: bool
    protocol: str
    scored_from: Manifest
    methods: dict[str, MethodConfig]
    cells: Annotated[list[FileName], AfterValidator(_all_different)]
    depth_from_files: bool = False
    """Whether another program made the inputs' depth, which may have seen the targets."""


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


def read_files(folder: Path, cell: Cell) -> tuple[dict[str, bytes], dict[str, bytes]]:
    """The contents of a finished cell's images, and of its points, by name."""
    images, points = (
        {name: read_limited(folder / name) for name in stated}
        for stated in (cell.images, cell.points)
    )
    return images, points


_DRAW = ("category", "sequence", "n_views", "draw", "seed")


@dataclass(frozen=True)
class CheckedOutput:
    """A method's output with what came along."""

    output: MethodOutput
    images: list[np.ndarray] = field(default_factory=list)
    """Pixels by target, `uint8` of `h w 3`."""
    points: np.ndarray | None = None


@dataclass(frozen=True)
class CellJob:
    """All that making and scoring one cell take."""

    folder: Path
    """Its name is the key."""
    scene: Path
    draw: Draw
    method: MethodConfig
    scoring: ScoringConfig
    device: str
    protocol: str
    made_from: Manifest
    scored_from: Manifest
    unscored_cell: Path | None = None
    """Folder of a cell with the same images, which only need scoring."""


def failed_output(reason: str) -> CheckedOutput:
    """The output of a method, or of a scoring, that gave none."""
    return CheckedOutput(MethodOutput(status=FAILED, reason=reason))


def _record(job: CellJob, output: MethodOutput) -> Cell:
    """The record of what a method made for a job."""
    measured = {each.name: getattr(output, each.name) for each in fields(MethodOutput)}
    return Cell(
        **measured,
        key=job.folder.name,
        method=job.method.name,
        scene=job.scene.name,
        protocol=job.protocol,
        made_from=job.made_from,
        scored_from=job.scored_from,
        **{name: getattr(job.draw, name) for name in _DRAW},
    )


def keep_output(job: CellJob, result: CheckedOutput) -> Cell:
    """Write a method's output as a cell that is not scored yet, or the reason why there is none."""
    record = _record(job, result.output)
    images = {f"{index}.png": png_bytes(pixels) for index, pixels in enumerate(result.images)}
    points = {}
    if result.points is not None:
        points["points.npy"] = npy_bytes(torch.from_numpy(result.points))
    return write_cell(job.folder, record, images, points)


def score_cell(job: CellJob) -> Cell:
    """Score and write a cell whose images are there; what cannot be scored is a failure."""
    torch.set_num_threads(1)
    from benchmarks.score.scoring import score_files  # heavy, and only scoring needs it

    assert job.unscored_cell is not None
    started = time.perf_counter()
    made = read_cell(job.unscored_cell)
    if made is None:
        raise InputError(f"{job.unscored_cell}: is gone; run the table again")
    images, points = read_files(job.unscored_cell, made)
    record = replace(_record(job, made), status=OK, reason="")
    try:
        scores = score_files(job.unscored_cell, images, points, Scene.open(job.scene), job.scoring)
        took = time.perf_counter() - started
        record = replace(record, metrics=scores, scoring_seconds=took)
    except ValueError as error:
        record = replace(record, status=FAILED, reason=one_line(f"not scored: {error}"))
    return write_cell(job.folder, record, images, points)


def write_cell(
    folder: Path, record: Cell, images: Mapping[str, bytes], points: Mapping[str, bytes]
) -> Cell:
    """Put a cell in its place; what stood there (a failed or an unscored one) goes."""
    record = replace(record, images=_hashes(images), points=_hashes(points))
    with atomic_folder(folder) as made:
        for name, content in {**images, **points}.items():
            (made / name).write_bytes(content)
        write_record(made / "cell.json", record)
    return record


def _hashes(files: Mapping[str, bytes]) -> dict[str, str]:
    return {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}
