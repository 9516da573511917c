"""One cell: a method on a draw. Its folder is named by all that decides the result, and is written
whole or not at all; a finished one is never changed.

<key>/cell.json, 0.png …   (the target images, in the order of the protocol's targets)
"""

import hashlib
import os
import shutil
import traceback
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.files import images_of, json_bytes
from benchmarks.making import MEASURED, Made, make
from benchmarks.methods.base import Unavailable
from benchmarks.provenance import versions
from benchmarks.scenes import Scene
from benchmarks.scoring import Score, score_files
from extrap_train.config import MethodConfig, ScoringConfig
from extrap_train.data.json_files import read_json
from extrap_train.store.atomic import write_atomic

OK, FAILED, UNAVAILABLE = "ok", "failed", "unavailable"
_DRAW = ("category", "sequence", "n_views", "draw", "seed")


@dataclass(frozen=True)
class CellJob:
    """All that a worker needs to make one cell."""

    folder: Path
    """Its name is the key."""
    scene: Path
    method: MethodConfig
    scoring: ScoringConfig
    device: str
    hashes: Mapping[str, str]
    """`protocol`, `rules`, `data`, `method`, `code`, `weights`, `images` (all that decides the
    images) and `scoring`.
    """
    images_from: Path | None = None
    """A finished cell with the very same images, which only need scoring again."""


def run_cell(job: CellJob) -> dict[str, Any]:
    """Make, score and write a cell; whatever goes wrong becomes its status, with the reason."""
    torch.set_num_threads(1)  # the same images, however many workers there are
    if job.device != "cuda":  # before anything asks for a GPU: from then on it is there
        os.environ["CUDA_VISIBLE_DEVICES"] = ""
    scene = Scene.open(job.scene)
    record = _head(job, scene)
    files: dict[str, bytes] = {}
    try:
        made = _made(job, scene)
        scores = score_files(made.images, made.points, scene.truth(), job.scoring)
        record |= {
            "status": OK,
            "reason": "",
            **made.measured,
            "metrics": {name: asdict(score) for name, score in scores.items()},
            "images": _hashes(made.images),
            "points": _hashes(made.points),
        }
        files = made.images | made.points
    except Unavailable as error:
        record |= {"status": UNAVAILABLE, "reason": str(error)}
    except Exception as error:
        record |= {
            "status": FAILED,
            "reason": f"{type(error).__name__}: {' '.join(str(error).split())[:300]}",
            "traceback": traceback.format_exc(),
        }
    write_cell(job.folder, record, files)
    return record


def _hashes(files: Mapping[str, bytes]) -> dict[str, str]:
    return {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}


def read_cell_files(folder: Path, record: Mapping[str, Any], kind: str) -> dict[str, bytes]:
    """The `images` or `points` of a finished cell."""
    return {name: (folder / name).read_bytes() for name in record.get(kind, {})}


def died_record(job: CellJob, reason: str) -> dict[str, Any]:
    """The record of a cell whose process ended without one."""
    record = _head(job, Scene.open(job.scene)) | {"status": FAILED, "reason": reason}
    write_cell(job.folder, record, {})
    return record


def _head(job: CellJob, scene: Scene) -> dict[str, Any]:
    draw = scene.draw
    return {
        "key": job.folder.name,
        "method": job.method.name,
        "options": dict(job.method.options),
        **{name: getattr(draw, name) for name in _DRAW},
        "scene": job.scene.name,
        "device": job.device,
        "hashes": dict(job.hashes),
        "versions": versions(),
    }


def _made(job: CellJob, scene: Scene) -> Made:
    if job.images_from is None:
        return make(job.method, scene)
    before = read_json(job.images_from / "cell.json")
    return Made(
        {name: before[name] for name in MEASURED},
        read_cell_files(job.images_from, before, "images"),
        read_cell_files(job.images_from, before, "points"),
    )


def read_cell_images(folder: Path, record: Mapping[str, Any]) -> Float[Tensor, "n 3 h w"]:
    """The saved images of a finished cell, in the targets' order."""
    return images_of(read_cell_files(folder, record, "images"))


def write_cell(folder: Path, record: Mapping[str, Any], files: Mapping[str, bytes]) -> None:
    """Write beside the final place and rename; what stood there (a failed cell) goes."""
    workshop = folder.with_name(f".{folder.name}.{os.getpid()}")
    shutil.rmtree(workshop, ignore_errors=True)
    try:
        for name, content in files.items():
            write_atomic(workshop / name, content)
        write_atomic(workshop / "cell.json", json_bytes(record))
        shutil.rmtree(folder, ignore_errors=True)
        workshop.replace(folder)
    finally:
        shutil.rmtree(workshop, ignore_errors=True)


def scores_of(record: Mapping[str, Any]) -> dict[str, Score]:
    """A finished cell's metrics."""
    return {name: Score(**entry) for name, entry in record.get("metrics", {}).items()}
