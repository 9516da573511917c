"""Which cells of a table need not be made again, or only scored."""

from collections.abc import Callable
from pathlib import Path

from benchmarks.cells import OK, CellJob
from benchmarks.plan import TableFolder
from benchmarks.records import read_record
from extrap_train.errors import InputError


def finished(
    jobs: list[CellJob], folder: TableFolder, say: Callable[[str], None]
) -> tuple[list[CellJob], list[CellJob]]:
    """The jobs that are done and those that are to be run, the latter with images to score again
    where only the scoring has changed. Damaged cells are announced and made anew.
    """
    done, open_jobs = [], []
    for job in jobs:
        record = _record(job.folder, say)
        if record is not None and record["status"] == OK:
            done.append(job)
        else:
            open_jobs.append(job)
    if open_jobs:
        images = _finished_images(folder, {job.folder for job in jobs})
        open_jobs = [_with_images(job, images.get(job.hashes["images"])) for job in open_jobs]
    return done, open_jobs


def _record(folder: Path, say: Callable[[str], None]) -> dict[str, object] | None:
    try:
        return read_record(folder)
    except InputError as error:
        say(f"{error}: made anew")
        return None


def _finished_images(folder: TableFolder, current: set[Path]) -> dict[str, Path]:
    """Cells of other scorings by what decides their images."""
    found: dict[str, Path] = {}
    for cell in folder.cells.glob("*/cell.json"):
        if cell.parent in current:
            continue
        try:
            record = read_record(cell.parent)
        except InputError:
            continue
        if record is not None and record["status"] == OK:
            found[record["hashes"]["images"]] = cell.parent
    return found


def _with_images(job: CellJob, images_from: Path | None) -> CellJob:
    return CellJob(**{**vars(job), "images_from": images_from})
