"""RealityCapture's (RealityScan's) table of internal and external camera parameters, as CSV.

Cameras have OpenGL's axes. Focal lengths are in millimetres of 36 mm film, offsets of the principal
point are shares of the photograph's longer side, and distortion is Brown's.
"""

import csv
from functools import partial
from pathlib import Path
from typing import Any

import torch

from extrap_train.data.image_files import stored_size
from extrap_train.data.lens_keys import number_of
from extrap_train.data.paths import require_file
from extrap_train.data.photogrammetry import PosedPicture, find_description, sequence_of_pictures
from extrap_train.data.sequences import FrameSequence
from extrap_train.errors import InputError
from extrap_train.geometry.foreign_cameras import opengl_from_heading

_POSITION, _ANGLES = ("x", "y", "alt"), ("heading", "pitch", "roll")
_REQUIRED = (*_POSITION, *_ANGLES, "f")
_DISTORTION = {"k1": "k1", "k2": "k2", "k3": "k3", "k4": "k4", "t1": "p1", "t2": "p2"}
_FILM_MM = 36.0
_MAX_BYTES = 64 * 2**20


def find_camera_table(folder: Path) -> Path | None:
    """The CSV file of cameras, None where there is none; InputError for several."""
    return find_description(folder, ".csv", _is_table)


def read_realitycapture(table: Path, name: str) -> FrameSequence:
    """The capture of a table that `find_camera_table` found.

    Lenses fit the photographs as they are stored, whatever their EXIF orientation.
    """
    if require_file(table).stat().st_size > _MAX_BYTES:
        raise InputError(f"{table}: has more than {_MAX_BYTES >> 20} MiB; export fewer cameras")
    lines = _lines(table.read_text("utf-8-sig", errors="replace"))
    columns, pictures, unusable = _columns(lines[0]), [], []
    if missing := [column for column in _REQUIRED if column not in columns]:
        raise InputError(
            f"{table}: has no {', '.join(missing)}; export `Internal/External camera parameters`"
        )
    if twice := [column for column in _REQUIRED if columns.count(column) > 1]:
        raise InputError(f"{table}: has more than one column {twice[0]}; remove the wrong one")
    try:
        rows = [row for row in csv.reader(lines[1:]) if row]
    except csv.Error as error:
        raise InputError(f"{table}: is not valid CSV ({error}); export it again") from None
    for row in rows:
        try:
            said = dict(zip(columns, row, strict=True))
            angles, position = (
                torch.tensor([number_of(said, key) for key in keys], dtype=torch.float64)
                for keys in (_ANGLES, _POSITION)
            )
        except ValueError as error:
            unusable.append(
                f"{table}: the row of {row[0]!r:.60} is malformed ({error}); correct it"
            )
        else:
            matrix = opengl_from_heading(angles.deg2rad(), position).numpy()
            pictures.append(PosedPicture(said["name"].strip(), matrix, partial(_lens, said)))
    return sequence_of_pictures(table, name, pictures, unusable)


def _lens(said: dict[str, str], picture: Path) -> dict[str, Any]:
    height, width = stored_size(picture)
    side = max(height, width)
    focal = number_of(said, "f") * side / _FILM_MM
    center = {"cx": width / 2 + number_of(said, "px", 0.0) * side}
    center["cy"] = height / 2 + number_of(said, "py", 0.0) * side
    distortion = {key: number_of(said, column, 0.0) for column, key in _DISTORTION.items()}
    return {"w": width, "h": height, "fl_x": focal, "fl_y": focal} | center | distortion


def _is_table(head: bytes) -> bool:
    lines = _lines(head.decode("utf-8", "replace"))
    return bool(lines) and lines[0].startswith("#name,")


def _lines(text: str) -> list[str]:
    """From the header on; the number of cameras may stand above it."""
    lines = text.removeprefix("\ufeff").splitlines()
    return lines[1:] if lines and lines[0].startswith("#cameras") else lines


def _columns(header: str) -> list[str]:
    return [column.strip().removeprefix("#").lower() for column in header.split(",")]
