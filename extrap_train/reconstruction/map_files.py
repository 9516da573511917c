"""The global map on disk: one file a view, whole or not at all, so that a killed run resumes."""

import io
import json
import zipfile
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch

from extrap_train.errors import InputError
from extrap_train.reconstruction.completion import Step
from extrap_train.reconstruction.global_map import GlobalMap, MapView, Origin
from extrap_train.store.atomic import write_atomic
from extrap_train.views import Camera, View


def view_file(folder: Path, index: int) -> Path:
    """Where the map's view with this index lies."""
    return folder / f"{index:03d}.npz"


def save_view(view: MapView, folder: Path, index: int) -> None:
    """Write one view; nothing is rounded."""
    content = io.BytesIO()
    np.savez_compressed(
        content,
        image=view.view.image.numpy(),
        depth=view.depth.numpy(),
        confidence=view.confidence.numpy(),
        fresh=view.fresh.numpy(),
        world_to_cam=view.camera.world_to_cam.numpy(),
        intrinsics=view.camera.intrinsics.numpy(),
        record=np.array(json.dumps({"name": view.view.name, **asdict(view.origin)})),
    )
    write_atomic(view_file(folder, index), content.getvalue())


def save_step(step: Step, folder: Path, index: int) -> None:
    """Write how the view with this index came about; goes before the view itself."""
    write_atomic(_step_file(folder, index), (json.dumps(asdict(step)) + "\n").encode())


def load_steps(folder: Path, count: int) -> list[Step]:
    """The steps of the generated ones among the first `count` views."""
    files = [_step_file(folder, index) for index in range(count)]
    return [Step(**json.loads(file.read_text())) for file in files if file.is_file()]


def _step_file(folder: Path, index: int) -> Path:
    return folder / f"{index:03d}.json"


def load_map(folder: Path, tolerance: float) -> GlobalMap:
    """The views that are there, up to the first that is missing."""
    views: list[MapView] = []
    while view_file(folder, len(views)).is_file():
        views.append(_load(view_file(folder, len(views))))
    return GlobalMap(tolerance, tuple(views))


def _load(path: Path) -> MapView:
    try:
        with np.load(path, allow_pickle=False) as saved:
            arrays = {name: saved[name] for name in saved.files}
        record = json.loads(str(arrays.pop("record")))
        tensors = {name: torch.from_numpy(array) for name, array in arrays.items()}
        height, width = tensors["depth"].shape
        camera = Camera(tensors["world_to_cam"], tensors["intrinsics"], height, width)
        name, references = record.pop("name"), tuple(record.pop("references"))
        return MapView(
            View(tensors["image"], camera, tensors["depth"], name=name),
            tensors["confidence"],
            tensors["fresh"],
            Origin(references=references, **record),
        )
    except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile) as error:
        raise InputError(
            f"{path}: is no view of a map ({error}); remove it and run again to resume before it"
        ) from None
