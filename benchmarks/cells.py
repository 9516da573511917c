"""One cell: a method on a draw. Its folder is named by all that decides the result, and is written
whole or not at all; a finished one is never changed.

<key>/cell.json, 0.png …   (the target images, in the order of the protocol's targets)
"""

import hashlib
import io
import os
import shutil
import traceback
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from benchmarks.files import json_bytes
from benchmarks.memory import PeakMemory
from benchmarks.methods.base import SceneInputs, Stopwatch, Synthesis, Unavailable
from benchmarks.methods.build import build_method
from benchmarks.provenance import versions
from benchmarks.recorded_depth import RecordedDepth
from benchmarks.scenes import Scene, Truth, npy_bytes, png_bytes
from benchmarks.scoring import Score, score_images, score_points
from extrap_train.config import MethodConfig, ScoringConfig
from extrap_train.data.files import write_whole
from extrap_train.data.json_files import read_json
from extrap_train.errors import InputError
from extrap_train.metrics import require_unit_range

OK, FAILED, UNAVAILABLE = "ok", "failed", "unavailable"
_DRAW = ("category", "sequence", "n_views", "draw", "seed")
_MEASURED = ("seconds", "wall_seconds", "peak_memory_mib", "given", "counts")
PER_IMAGE = "per image"
"""`MethodConfig.time` of the methods whose perform time is that of one image."""


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
    pictures: dict[str, bytes] = {}
    points: dict[str, bytes] = {}
    try:
        made, pictures, points = _made(job, scene)
        record |= {"status": OK, "reason": "", **made}
        scores = score_cell(pictures, points, scene.truth(), job.scoring)
        record["metrics"] = {name: asdict(score) for name, score in scores.items()}
        record["images"] = {name: hashlib.sha256(c).hexdigest() for name, c in pictures.items()}
        record["points"] = {name: hashlib.sha256(c).hexdigest() for name, c in points.items()}
    except Unavailable as error:
        record |= {"status": UNAVAILABLE, "reason": str(error)}
    except Exception as error:
        record |= {
            "status": FAILED,
            "reason": f"{type(error).__name__}: {' '.join(str(error).split())[:300]}",
            "traceback": traceback.format_exc(),
        }
    write_cell(job.folder, record, pictures | points if record["status"] == OK else {})
    return record


def score_cell(
    pictures: Mapping[str, bytes], points: Mapping[str, bytes], truth: Truth, scoring: ScoringConfig
) -> dict[str, Score]:
    """Every metric of a cell from its files."""
    images = score_images(read_images_from(pictures), truth, scoring)
    clouds = [torch.from_numpy(np.load(io.BytesIO(content))) for content in points.values()]
    return images | score_points(clouds[0] if clouds else None, truth)


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


def _made(job: CellJob, scene: Scene) -> tuple[dict[str, Any], dict[str, bytes], dict[str, bytes]]:
    """What was measured while the images were made, the images as files, and the points as one,
    where the method has any.
    """
    if job.images_from is not None:
        before = read_json(job.images_from / "cell.json")
        pictures, points = (
            read_cell_files(job.images_from, before, kind) for kind in ("images", "points")
        )
        return {name: before[name] for name in _MEASURED}, pictures, points
    inputs = scene.inputs()
    with PeakMemory() as memory, Stopwatch() as watch:
        synthesis = _synthesize(job, inputs)
    pictures = {f"{i}.png": png_bytes(image) for i, image in enumerate(synthesis.images)}
    made = {
        "seconds": synthesis.seconds + _depth_share(inputs, job.method),
        "wall_seconds": watch.seconds,
        "peak_memory_mib": memory.mib,
        "given": dict(synthesis.given),
        "counts": dict(synthesis.counts),
    }
    points = {} if synthesis.points is None else {"points.npy": npy_bytes(synthesis.points)}
    return made, pictures, points


def _synthesize(job: CellJob, inputs: SceneInputs) -> Synthesis:
    torch.manual_seed(inputs.seed)
    synthesis = build_method(job.method).synthesize(inputs)
    wanted = (len(inputs.targets.world_to_cam), 3, inputs.targets.height, inputs.targets.width)
    if tuple(synthesis.images.shape) != wanted:
        found = tuple(synthesis.images.shape)
        raise InputError(f"method {job.method.name}: made images {found}, asked were {wanted}")
    require_unit_range(synthesis.images)
    return synthesis


def _depth_share(inputs: SceneInputs, method: MethodConfig) -> float:
    """What finding the inputs' depth took, for the methods that asked for it."""
    assert isinstance(inputs.depth_source, RecordedDepth)
    count = len(inputs.targets.world_to_cam) if method.time == PER_IMAGE else 1
    return inputs.depth_source.seconds / count


def read_images_from(pictures: Mapping[str, bytes]) -> Float[Tensor, "n 3 h w"]:
    """The images as their files hold them: 8 bits."""
    arrays = [np.array(Image.open(io.BytesIO(content))) for content in pictures.values()]
    return torch.from_numpy(np.stack(arrays)).permute(0, 3, 1, 2).float() / 255


def read_cell_images(folder: Path, record: Mapping[str, Any]) -> Float[Tensor, "n 3 h w"]:
    """The saved images of a finished cell, in the targets' order."""
    return read_images_from(read_cell_files(folder, record, "images"))


def write_cell(folder: Path, record: Mapping[str, Any], files: Mapping[str, bytes]) -> None:
    """Write beside the final place and rename; what stood there (a failed cell) goes."""
    workshop = folder.with_name(f".{folder.name}.{os.getpid()}")
    shutil.rmtree(workshop, ignore_errors=True)
    try:
        for name, content in files.items():
            write_whole(workshop / name, content)
        write_whole(workshop / "cell.json", json_bytes(record))
        shutil.rmtree(folder, ignore_errors=True)
        workshop.replace(folder)
    finally:
        shutil.rmtree(workshop, ignore_errors=True)


def read_cell(folder: Path) -> dict[str, Any] | None:
    """A cell's record; None where there is none. Raises InputError where it is damaged."""
    if not (folder / "cell.json").is_file():
        return None
    record = read_json(folder / "cell.json")
    if not isinstance(record, dict) or record.get("key") != folder.name or not _is_whole(record):
        raise InputError(f"{folder / 'cell.json'}: is no record of this cell")
    for name, stated in (record.get("images", {}) | record.get("points", {})).items():
        file = folder / name
        if not file.is_file() or hashlib.sha256(file.read_bytes()).hexdigest() != stated:
            raise InputError(f"{file}: is missing, or not what its cell's hash says")
    return record


def _is_whole(record: Mapping[str, Any]) -> bool:
    """Whether it has every entry that is read from a cell of its status."""
    needed = {"method", "status", "reason", "scene", "device", "hashes", *_DRAW}
    if record.get("status") == OK:
        needed |= {"metrics", "images", "points", *_MEASURED}
    return needed <= record.keys()


def scores_of(record: Mapping[str, Any]) -> dict[str, Score]:
    """A finished cell's metrics."""
    return {name: Score(**entry) for name, entry in record.get("metrics", {}).items()}
