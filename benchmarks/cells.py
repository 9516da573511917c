"""One cell: a method on a draw. Its folder is named by all that decides the result, and is written
whole or not at all; a finished one is never changed.

<key>/cell.json, 0.png …   (the target images, in the order of the protocol's targets)

First the method makes the images, in a process of its own and without any truth (`making`); what
it hands out is let in (`door`) and kept. Later the images are scored.
"""

import hashlib
import time
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Literal

import torch

from benchmarks.cell_job import CellJob
from benchmarks.door import LetIn
from benchmarks.files import npy_bytes, png_bytes
from benchmarks.provenance import versions
from benchmarks.records import FAILED, OK, Cell, files_of, read_cell
from benchmarks.scenes import Scene
from benchmarks.words import one_line
from extrap_train.errors import InputError
from extrap_train.store.atomic import atomic_folder
from extrap_train.store.records import write_record

_DRAW = ("category", "sequence", "n_views", "draw", "seed")
_CARRIED = (
    "versions", "seconds", "wall_seconds", "peak_memory_mib", "given", "counts", "truths_apart",
)  # fmt: skip
"""What a cell takes over from another with the very same images."""


def _record(
    job: CellJob, status: Literal["ok", "failed", "unavailable", "made"], reason: str = ""
) -> Cell:
    """A record that holds what the job says."""
    return Cell(
        key=job.folder.name,
        method=job.method.name,
        options=dict(job.method.options),
        scene=job.scene.name,
        device=job.device,
        hashes=job.hashes,
        status=status,
        reason=reason,
        versions=versions(),
        **{name: getattr(job.draw, name) for name in _DRAW},
    )


def keep(job: CellJob, result: LetIn, truths_apart: bool) -> Cell:
    """Write the cell of what a method has made, unscored, or of why it has not."""
    handed = result.handed
    record = replace(_record(job, handed.status, handed.reason), traceback=handed.traceback)
    images = {f"{index}.png": png_bytes(pixels) for index, pixels in enumerate(result.images)}
    points = {}
    if result.points is not None:
        points["points.npy"] = npy_bytes(torch.from_numpy(result.points))
    if handed.measured is not None:
        record = replace(record, truths_apart=truths_apart, **asdict(handed.measured))
    return write_cell(job.folder, record, images, points)


def score_cell(job: CellJob) -> Cell:
    """Score and write a cell whose images are there; what cannot be scored is a failure."""
    torch.set_num_threads(1)
    from benchmarks.scoring import score_files  # heavy, and only those who score need it

    assert job.images_from is not None
    started = time.perf_counter()
    made = read_cell(job.images_from)
    if made is None:
        raise InputError(f"{job.images_from}: is gone; run the table again")
    images, points = (files_of(job.images_from, kind) for kind in (made.images, made.points))
    record = replace(_record(job, OK), **{name: getattr(made, name) for name in _CARRIED})
    try:
        scores = score_files(job.images_from, images, points, Scene.open(job.scene), job.scoring)
        took = time.perf_counter() - started
        record = replace(record, metrics=scores, scoring_seconds=took)
    except ValueError as error:
        record = replace(record, status=FAILED, reason=one_line(f"not scored: {error}"))
    return write_cell(job.folder, record, images, points)


def fail(job: CellJob, reason: str) -> Cell:
    """Write the cell of a job whose process ended without a record."""
    return write_cell(job.folder, _record(job, FAILED, reason), {}, {})


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
