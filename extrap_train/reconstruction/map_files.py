"""The global map on disk, view by view, so that a killed run resumes after the last whole one.

NNN.json says how a view came about; NNN.safetensors, written after it, holds its pixels.
"""

from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Literal

import torch
from pydantic import Field
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from extrap_train.data.camera_check import is_degenerate
from extrap_train.errors import InputError
from extrap_train.reconstruction.completion import Step
from extrap_train.reconstruction.global_map import GlobalMap, MapView, Origin
from extrap_train.store.atomic import write_atomic
from extrap_train.store.records import read_record, write_record
from extrap_train.views import Camera, View

_REMEDY = "remove it and run again to resume before it"
_MAX_SIDE = 4096
_BYTES_PER_PIXEL = 21
"""Bytes per pixel of a stored view: colours, depth and confidence in float32, a flag."""
_RECORD_BYTES = 2**13

_Index = Annotated[int, Field(ge=0)]


@dataclass(frozen=True)
class _ViewRecord:
    """NNN.json: a view's name and origin, and how it was added; null for a given one."""

    name: str
    kind: Literal["given", "generated"]
    root: _Index
    references: list[_Index]
    seed: int
    agreement: float
    size: Annotated[int, Field(ge=1, le=_MAX_SIDE)]
    """Side of the square, in pixels."""
    sha256: str
    """SHA-256 of NNN.safetensors."""
    step: Step | None


def view_file(folder: Path, index: int) -> Path:
    """Where the pixels of the map's view with this index lie; there only if the view is whole."""
    return folder / f"{index:03d}.safetensors"


def view_bytes(size: int) -> int:
    """About how much disk one view takes, `size` pixels square."""
    return _BYTES_PER_PIXEL * size**2 + _RECORD_BYTES


def save_view(view: MapView, step: Step | None, folder: Path, index: int) -> None:
    """Write one view, and how it was added if it was generated; nothing is rounded.

    Raises InputError if any of its numbers is not finite.
    """
    tensors = {
        "image": view.view.image,
        "depth": view.depth,
        "confidence": view.confidence,
        "fresh": view.fresh,
        "world_to_cam": view.camera.world_to_cam,
        "intrinsics": view.camera.intrinsics,
    }
    if odd := [name for name, tensor in tensors.items() if not tensor.isfinite().all()]:
        raise InputError(
            f"view {view.view.name}: its {odd[0]} is not finite (NaN); either the weights "
            "that made it are damaged, or numbers became too large for trainer.precision: give "
            "32-true"
        )
    content = save({name: tensor.contiguous() for name, tensor in tensors.items()})
    origin = view.origin
    record = _ViewRecord(
        name=view.view.name,
        kind=origin.kind,  # type: ignore[arg-type]
        root=origin.root,
        references=list(origin.references),
        seed=origin.seed,
        agreement=origin.agreement,
        size=view.camera.width,
        sha256=sha256(content).hexdigest(),
        step=step,
    )
    write_record(_record_file(folder, index), record)
    write_atomic(view_file(folder, index), content)


@dataclass(frozen=True)
class _InputsRecord:
    """inputs.json: how long it took to measure the given views."""

    seconds: float


def save_input_seconds(seconds: float, folder: Path) -> None:
    """Note how long measuring the given views took."""
    write_record(folder / "inputs.json", _InputsRecord(seconds))


def load_input_seconds(folder: Path) -> float:
    """How long measuring the given views took, in whichever run."""
    file = folder / "inputs.json"
    return read_record(file, _InputsRecord, "use resume=false to start over").seconds


def load_steps(folder: Path, count: int) -> list[Step]:
    """The steps of the generated ones among the first `count` views."""
    records = [_read_record(folder, index) for index in range(count)]
    return [record.step for record in records if record.step is not None]


def load_map(folder: Path, tolerance: float) -> GlobalMap:
    """The views that are there, up to the first that is missing; InputError for a damaged one."""
    views: list[MapView] = []
    while view_file(folder, len(views)).is_file():
        views.append(_load(folder, len(views)))
    return GlobalMap(tolerance, tuple(views))


def _record_file(folder: Path, index: int) -> Path:
    return folder / f"{index:03d}.json"


def _read_record(folder: Path, index: int) -> _ViewRecord:
    file = _record_file(folder, index)
    return read_record(file, _ViewRecord, f"remove it and {view_file(folder, index).name}")


def _load(folder: Path, index: int) -> MapView:
    path, record = view_file(folder, index), _read_record(folder, index)
    if max([record.root, *record.references]) > index:
        raise InputError(f"{_record_file(folder, index)}: names later views; {_REMEDY}")
    tensors = _read_tensors(path, record)
    camera = Camera(tensors["world_to_cam"], tensors["intrinsics"], record.size, record.size)
    if bool(is_degenerate(camera)):
        raise InputError(f"{path}: its camera is degenerate; {_REMEDY}")
    return MapView(
        View(tensors["image"], camera, tensors["depth"], name=record.name),
        tensors["confidence"],
        tensors["fresh"],
        Origin(record.kind, record.root, tuple(record.references), record.seed, record.agreement),
    )


def _read_tensors(path: Path, record: _ViewRecord) -> dict[str, Tensor]:
    """The very tensors that were saved with the record, of the size that it says."""
    plane, real = (record.size, record.size), torch.float32
    wanted = {
        "image": ((3, *plane), real),
        "depth": (plane, real),
        "confidence": (plane, real),
        "fresh": (plane, torch.bool),
        "world_to_cam": ((4, 4), real),
        "intrinsics": ((3, 3), real),
    }
    if path.stat().st_size > view_bytes(record.size):
        raise InputError(f"{path}: is larger than a view of {record.size} pixels; {_REMEDY}")
    content = path.read_bytes()
    if sha256(content).hexdigest() != record.sha256:
        raise InputError(f"{path}: is damaged (its checksum is another); {_REMEDY}")
    try:
        tensors = load(content)
    except (SafetensorError, ValueError) as error:
        raise InputError(f"{path}: is not a view of a map ({error}); {_REMEDY}") from None
    if {name: (tuple(x.shape), x.dtype) for name, x in tensors.items()} != wanted:
        raise InputError(f"{path}: holds no view of {record.size} pixels; {_REMEDY}")
    if not all(x.isfinite().all() for x in tensors.values()):
        raise InputError(f"{path}: holds numbers that are not finite; {_REMEDY}")
    return tensors
