"""One cell: a method on a draw. Its folder is named by all that decides the result, and is written
whole or not at all; a finished one is never changed.

<key>/cell.json, 0.png …   (the target images, in the order of the protocol's targets)

First the method makes the images, in a process of its own and without any truth (`run_method`);
its output is checked (`method_output`) and kept. Later the images are scored.
"""

import hashlib
import time
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path

import torch

from benchmarks.protocol.array_files import npy_bytes, png_bytes
from benchmarks.protocol.draws import Draw
from benchmarks.protocol.prepared_scene import Scene
from benchmarks.run.cell_record import (
    FAILED,
    MADE,
    OK,
    Cell,
    MethodOutput,
    files_of,
    one_line,
    read_cell,
)
from benchmarks.run.method_output import CheckedOutput
from extrap_train.config import MethodConfig, ScoringConfig
from extrap_train.errors import InputError
from extrap_train.store.atomic import atomic_folder
from extrap_train.store.manifest import Manifest
from extrap_train.store.records import write_record

_DRAW = ("category", "sequence", "n_views", "draw", "seed")


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
    images_from: Path | None = None
    """A cell with the very same images, which only need scoring."""


def _record(job: CellJob, output: MethodOutput, *, truths_apart: bool = False) -> Cell:
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
        truths_apart=truths_apart,
        **{name: getattr(job.draw, name) for name in _DRAW},
    )


def keep_output(job: CellJob, result: CheckedOutput, truths_apart: bool) -> Cell:
    """Write the cell of what a method has made, unscored, or of why it has not."""
    is_made = result.output.status == MADE
    record = _record(job, result.output, truths_apart=truths_apart and is_made)
    images = {f"{index}.png": png_bytes(pixels) for index, pixels in enumerate(result.images)}
    points = {}
    if result.points is not None:
        points["points.npy"] = npy_bytes(torch.from_numpy(result.points))
    return write_cell(job.folder, record, images, points)


def score_cell(job: CellJob) -> Cell:
    """Score and write a cell whose images are there; what cannot be scored is a failure."""
    torch.set_num_threads(1)
    from benchmarks.score.scoring import score_files  # heavy, and only scoring needs it

    assert job.images_from is not None
    started = time.perf_counter()
    made = read_cell(job.images_from)
    if made is None:
        raise InputError(f"{job.images_from}: is gone; run the table again")
    images, points = (files_of(job.images_from, kind) for kind in (made.images, made.points))
    record = replace(_record(job, made, truths_apart=made.truths_apart), status=OK, reason="")
    try:
        scores = score_files(job.images_from, images, points, Scene.open(job.scene), job.scoring)
        took = time.perf_counter() - started
        record = replace(record, metrics=scores, scoring_seconds=took)
    except ValueError as error:
        record = replace(record, status=FAILED, reason=one_line(f"not scored: {error}"))
    return write_cell(job.folder, record, images, points)


def write_failure(job: CellJob, reason: str) -> Cell:
    """Write the cell of a job whose process ended without a record."""
    return write_cell(job.folder, _record(job, MethodOutput(status=FAILED, reason=reason)), {}, {})


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
