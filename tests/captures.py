"""A tiny capture with every kind of file, made for the readers' tests."""

import copy
import gzip
import json
import tempfile
from functools import cache
from pathlib import Path

import torch
from scenes import Scene, orbit_camera, plane, sphere

from extrap_train.data.co3d.writer import write_annotations, write_frame, write_sequence
from extrap_train.views import View

SCENE = Scene((sphere(0.8), plane(0.9, (0.0, 1.0, 0.0))))


def view_at(azimuth_deg: float, size: int = 32) -> View:
    """A view from this side, each time another copy."""
    return copy.deepcopy(_rendered(azimuth_deg, size))


@cache
def _rendered(azimuth_deg: float, size: int) -> View:
    camera = orbit_camera(azimuth_deg, size=size).cropped(0, 0, size, size + 8)
    depth = SCENE.depth(camera)
    # The horizon is further away than a file of millimetres can say.
    depth[depth > 50] = 0
    mask = (Scene((sphere(0.8),)).depth(camera) > 0).float()
    return View(SCENE.image(camera), camera, depth, mask)


def write_capture(
    root: Path,
    names: tuple[str, ...] = ("one", "two"),
    frames: int = 3,
    size: int = 32,
    step_deg: float = 30,
) -> None:
    """Category `cup` with sequences of a few frames; the frame numbers are 1, 11, 21, …"""
    for path, content in _written(names, frames, size, step_deg).items():
        (root / path).parent.mkdir(parents=True, exist_ok=True)
        (root / path).write_bytes(content)


@cache
def _written(names: tuple[str, ...], frames: int, size: int, step_deg: float) -> dict[Path, bytes]:
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        _write(root, names, frames, size, step_deg)
        files = [path for path in root.rglob("*") if path.is_file()]
        return {path.relative_to(root): path.read_bytes() for path in files}


def _write(root: Path, names: tuple[str, ...], frames: int, size: int, step_deg: float) -> None:
    entries = [
        # Written backwards: the reader is to sort.
        write_frame(root, "cup", name, 10 * index + 1, view_at(step_deg * index, size))
        for name in names
        for index in reversed(range(frames))
    ]
    points, colors = torch.rand(20, 3), torch.rand(20, 3)
    sequences = [write_sequence(root, "cup", name, points, colors) for name in names]
    write_annotations(
        root, "cup", entries, sequences, {"train": list(names[:1]), "test": list(names[1:])}
    )


def frame_entries(root: Path) -> list[dict]:
    return json.loads(gzip.decompress((root / "cup" / "frame_annotations.jgz").read_bytes()))


def replace_frame_entries(root: Path, entries: object) -> None:
    content = gzip.compress(json.dumps(entries).encode())
    (root / "cup" / "frame_annotations.jgz").write_bytes(content)
