"""Which cells of a table need not be made again, or only scored."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from benchmarks.cell_job import CellJob
from benchmarks.plan import TableFolder
from benchmarks.records import OK, Cell, read_cell
from extrap_train.errors import InputError


@dataclass(frozen=True)
class Open:
    """The jobs of a table by what is left to do."""

    done: list[CellJob]
    to_make: list[CellJob]
    to_score: list[CellJob]
    """They know where the images are that their method has made."""


def sort_jobs(jobs: list[CellJob], folder: TableFolder, say: Callable[[str], None]) -> Open:
    """Look what is there; damaged cells are announced and made again."""
    sorted_jobs = Open([], [], [])
    rest = []
    for job in jobs:
        cell = _cell(job.folder, say)
        if cell is not None and cell.status == OK:
            sorted_jobs.done.append(job)
        else:
            rest.append(job)
    images = _images(folder) if rest else {}
    for job in rest:
        there = images.get(job.hashes.images)
        if there is None:
            sorted_jobs.to_make.append(job)
        else:
            sorted_jobs.to_score.append(replace(job, images_from=there))
    return sorted_jobs


def _cell(folder: Path, say: Callable[[str], None]) -> Cell | None:
    try:
        return read_cell(folder)
    except InputError as error:
        say(f"{error}: made again")
        return None


def _images(folder: TableFolder) -> dict[str, Path]:
    """Cells that hold images, by what decides those."""
    found: dict[str, Path] = {}
    for file in folder.cells.glob("*/cell.json"):
        cell = _cell(file.parent, lambda _: None)
        if cell is not None and cell.images:
            found[cell.hashes.images] = file.parent
    return found
