"""Cameras that a photogrammetry program has written into one file beside the photographs."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from extrap_train.data.camera_check import OPENGL_POSES
from extrap_train.data.listed_files import ListedFiles
from extrap_train.data.listed_photographs import (
    Listed,
    ListedPhotograph,
    sequence_of_photographs,
)
from extrap_train.data.paths import check_relative
from extrap_train.data.posed_entries import names_faults, photograph_of_entry
from extrap_train.data.sequences import FrameSequence
from extrap_train.errors import InputError

_MAX_AWAY = 100.0
"""How far from the origin cameras may stand, in their extents, before single precision shows."""
_HEAD_BYTES = 4096

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class PosedPicture:
    """What a file says of one photograph."""

    label: str
    """Its name, with or without a suffix and folders."""
    cam_to_world: Float[np.ndarray, "4 4"]
    """With OpenGL axes, which may be scaled uniformly."""
    describe: Callable[[Path], dict[str, Any]]
    """Its size and lens as in a `transforms.json`, by where the photograph is; may raise what
    `names_faults` turns into InputError."""


def find_description(folder: Path, suffix: str, fits: Callable[[bytes], bool]) -> Path | None:
    """The file of a folder whose beginning `fits`; InputError where several do."""
    files = (file for file in sorted(folder.glob(f"*{suffix}")) if file.is_file())
    found = [file for file in files if fits(_head(file))]
    if len(found) > 1:
        raise InputError(
            f"{folder}: both {found[0].name} and {found[1].name} describe cameras; keep one of them"
        )
    return found[0] if found else None


def sequence_of_pictures(
    file: Path, name: str, pictures: Sequence[PosedPicture], unusable: Sequence[str]
) -> FrameSequence:
    """The capture of a file whose photographs are beside it or in `images`; see
    `sequence_of_photographs`.
    """
    images = file.parent / "images"
    files = ListedFiles(images if images.is_dir() else file.parent)
    offset = _map_offset(np.array([p.cam_to_world[:3, 3] for p in pictures]).reshape(-1, 3), file)
    listed, faults = [], [*unusable]
    for picture in pictures:
        try:
            path = check_relative(picture.label.replace("\\", "/").rsplit("/", 1)[-1], file)
        except InputError as error:
            faults.append(str(error))
        else:
            listed.append(Listed(path, partial(_photograph, files.root, file, picture, offset)))
    if not listed:
        raise InputError(faults[0] if faults else f"{file}: lists no cameras; export it again")
    return sequence_of_photographs(files, name, listed, file, OPENGL_POSES, faults)


def _photograph(
    root: Path, file: Path, picture: PosedPicture, offset: Float[np.ndarray, "3"], path: str
) -> ListedPhotograph:
    with names_faults(file, path):
        matrix = picture.cam_to_world.copy()
        matrix[:3, 3] -= offset
        entry = picture.describe(root / path) | {"transform_matrix": matrix.tolist()}
        return photograph_of_entry(root, entry, path)


def _map_offset(positions: Float[np.ndarray, "n 3"], file: Path) -> Float[np.ndarray, "3"]:
    """The middle of cameras that stand far from the origin, as on a map; else zero."""
    finite = positions[np.isfinite(positions).all(1)]
    if not len(finite):
        return np.zeros(3)
    with np.errstate(over="ignore", invalid="ignore"):  # of positions that no scene has
        middle = finite.mean(0)
        away, extent = np.linalg.norm(middle), np.linalg.norm(finite - middle, axis=1).max()
    if not np.inf > away > _MAX_AWAY * extent > 0:
        return np.zeros(3)
    log.warning(
        "%s: its cameras stand far from the origin, as on a map, so their middle (%s) becomes the "
        "origin",
        file,
        ", ".join(f"{coordinate:.3f}" for coordinate in middle),
    )
    return middle


def _head(file: Path) -> bytes:
    try:
        with file.open("rb") as stream:
            return stream.read(_HEAD_BYTES)
    except OSError:
        return b""
