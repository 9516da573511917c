"""COLMAP's sparse models as captures: cameras and poses, text and binary, without the points.

Read here and not by pycolmap, which trusts the counts that a file states and hangs on damaged ones.
"""

import logging
import mmap
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from extrap_train.data.camera_check import COLMAP_POSES
from extrap_train.data.image_files import MAX_PIXELS
from extrap_train.data.listed_files import ListedFiles
from extrap_train.data.listed_photographs import (
    Listed,
    ListedPhotograph,
    sequence_of_photographs,
)
from extrap_train.data.paths import MAX_PATH_BYTES, check_relative
from extrap_train.data.sequences import FrameSequence, PointFile
from extrap_train.errors import InputError
from extrap_train.geometry.cuts import Equirectangular
from extrap_train.geometry.foreign_cameras import (
    CAMERA_MODELS,
    NAMES_AND_COUNTS,
    lens_from_parameters,
    world_to_cam_from_colmap,
)
from extrap_train.geometry.lens import Lens

POINT_CLOUD = "points3D.ply"
"""Some tools leave one beside the model."""
_KINDS = ("bin", "txt")
_MAX_LINE_CHARACTERS = 2**24
"""A line of points takes about twenty for each."""
_POINT_2D_BYTES = 24
"""x, y and the number of the point in space, 8 bytes each."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ModelCamera:
    """A camera of a model, of any of COLMAP's camera models."""

    number: int
    model: str
    height: int
    width: int
    parameters: tuple[float, ...]
    fault: str = ""
    """What is wrong with its entry, which then says nothing else."""


@dataclass(frozen=True)
class ModelImage:
    """A posed picture of a model."""

    name: str
    camera: int
    quaternion_wxyz: tuple[float, ...]
    translation: tuple[float, ...]
    fault: str = ""
    """What is wrong with its entry, which then says nothing but the name, if that."""


def find_model(folder: Path) -> Path | None:
    """The folder of the model: `folder`, the largest in its `sparse`, `sparse`, or one in `colmap`.

    COLMAP's mapper leaves one model for each part of the photographs that it could connect. Those
    that are not taken are named in a warning.
    """
    if _images_file(folder):
        return folder
    sparse, inner = folder / "sparse", folder / "colmap"
    parts = sorted(path for path in sparse.glob("*") if _images_file(path))
    if not parts:
        found = find_model(inner) if inner.is_dir() else None
        return sparse if _images_file(sparse) else found
    if len(parts) == 1:
        return parts[0]
    counts = {part: _count_images(part) for part in parts}
    largest = max(parts, key=lambda part: counts[part])
    others = [f"{part.name} has {counts[part]}" for part in parts if part != largest]
    log.warning(
        "%s: holds %d models, of which %s with %d pictures is read (%s); name another with "
        "scene=%s/NUMBER",
        sparse,
        len(parts),
        largest.name,
        counts[largest],
        ", ".join(others[:4]),
        sparse,
    )
    return largest


def read_model(model: Path, images: Path, name: str, upright: bool = False) -> FrameSequence:
    """The capture of a COLMAP model; `images` is the folder that its picture names start from.

    Distortion is undone when a frame is read. Entries without a picture, and those with a camera
    that cannot be used, are left out. The cameras of an `upright` model hold the pictures as their
    EXIF orientation turns them.
    """
    images_file = _images_file(model) or model / "images.bin"
    cameras_file = model / f"cameras{images_file.suffix}"
    for file in (cameras_file, images_file):
        if not file.is_file():
            raise InputError(f"{file}: no such file; export the whole COLMAP model")
    cameras, entries = read_model_cameras(cameras_file), read_model_images(images_file)
    if not entries:
        raise InputError(f"{images_file}: lists no picture; run COLMAP again")
    listed, unusable = [], []
    for entry in entries:
        try:
            path = check_relative(entry.name, images_file)
        except InputError as error:
            unusable.append(entry.fault or str(error))
        else:
            listed.append(Listed(path, partial(_photograph, entry, cameras, cameras_file, upright)))
    cloud = PointFile(model, POINT_CLOUD)
    return sequence_of_photographs(
        ListedFiles(images), name, listed, images_file, COLMAP_POSES, unusable, cloud
    )


def _images_file(folder: Path) -> Path | None:
    """The file that lists a model's images, in binary before text; None where there is none."""
    files = (folder / f"images.{kind}" for kind in _KINDS)
    return next((file for file in files if file.is_file()), None)


def _count_images(model: Path) -> int:
    """0 where the file that lists them is damaged."""
    file = _images_file(model)
    try:
        return len(read_model_images(file)) if file else 0
    except InputError:
        return 0


def _photograph(
    entry: ModelImage, cameras: dict[int, ModelCamera], file: Path, upright: bool, path: str
) -> ListedPhotograph:
    if entry.fault:
        raise InputError(f"{entry.name}: {entry.fault}")
    if entry.camera not in cameras:
        raise InputError(
            f"{file}: {entry.name} names camera {entry.camera}, which the model does not have; "
            "export the model again"
        )
    camera = cameras[entry.camera]
    quaternion = torch.tensor(entry.quaternion_wxyz, dtype=torch.float64)
    translation = torch.tensor(entry.translation, dtype=torch.float64)
    return ListedPhotograph(
        image_path=path,
        height=camera.height,
        width=camera.width,
        lens=_lens(camera, file),
        world_to_cam=world_to_cam_from_colmap(quaternion, translation),
        upright=upright,
    )


def _lens(camera: ModelCamera, file: Path) -> Lens | Equirectangular:
    """InputError where the model cannot be undone or the entry makes no sense."""
    if camera.fault:
        raise InputError(camera.fault)
    model = next((model for model in CAMERA_MODELS if model.name == camera.model), None)
    if model is None:
        raise InputError(
            f"{file}: camera {camera.number} is of the model {camera.model}, and only "
            f"{', '.join(m.name for m in CAMERA_MODELS)} can be undone; run COLMAP's "
            "image_undistorter first"
        )
    where = f"{file}: camera {camera.number} ({model.name})"
    if len(camera.parameters) != len(model.parameters):
        fault = f"{len(camera.parameters)} parameters, expected {len(model.parameters)}"
        raise InputError(f"{where} has {fault}; export the model again")
    height, width = camera.height, camera.width
    named = dict(zip(model.parameters, camera.parameters, strict=True))
    is_size = (named.get("h", height), named.get("w", width)) == (height, width)
    if height <= 0 or width <= 0 or height * width > MAX_PIXELS or not is_size:
        raise InputError(
            f"{where}: its size {height} x {width} is not valid; export the model again"
        )
    return Equirectangular() if "w" in named else lens_from_parameters(named, model.fisheye)


def read_model_cameras(file: Path) -> dict[int, ModelCamera]:
    """Every camera of a `cameras.bin` or `cameras.txt`, by its number."""
    found: dict[int, ModelCamera] = {}
    for camera in _binary_cameras(file) if file.suffix == ".bin" else _text_cameras(file):
        if found.setdefault(camera.number, camera) != camera:
            fault = f"{file}: lists camera {camera.number} twice; export the model again"
            found[camera.number] = replace(camera, fault=fault)
    return found


def read_model_images(file: Path) -> list[ModelImage]:
    """Every image of an `images.bin` or `images.txt`."""
    return _binary_images(file) if file.suffix == ".bin" else _text_images(file)


class _Cursor:
    """Walks through the little-endian values of a file; struct.error past its end."""

    def __init__(self, content: mmap.mmap) -> None:
        self.content, self.at = content, 0

    def read(self, layout: str) -> tuple[Any, ...]:
        values = struct.unpack_from(f"<{layout}", self.content, self.at)
        self.at += struct.calcsize(f"<{layout}")
        return values

    def read_name(self) -> str:
        end = self.content.find(b"\0", self.at, self.at + MAX_PATH_BYTES + 1)
        if end < 0:
            raise struct.error("a name has no end")
        name = self.content[self.at : end].decode(errors="surrogateescape")
        self.at = end + 1
        return name


@contextmanager
def _cursor(file: Path) -> Iterator[_Cursor]:
    try:
        with (
            file.open("rb") as stream,
            mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as content,
        ):
            cursor = _Cursor(content)
            yield cursor
            if cursor.at > len(content):
                raise struct.error("the last image's points are missing")
    except InputError:
        raise
    except (struct.error, ValueError, OverflowError):  # ValueError: an empty file
        raise InputError(f"{file}: is truncated or damaged; export the model again") from None
    except OSError as error:
        raise InputError(f"{file}: cannot be read ({error.strerror}); check the file") from None


def _binary_cameras(file: Path) -> list[ModelCamera]:
    cameras = []
    with _cursor(file) as cursor:
        for _ in range(*cursor.read("Q")):
            number, model, width, height = cursor.read("iiQQ")
            if model not in NAMES_AND_COUNTS:
                raise InputError(
                    f"{file}: camera {number} is of the model {model}, which is unknown here; run "
                    "COLMAP's image_undistorter first"
                )
            name, count = NAMES_AND_COUNTS[model]
            cameras.append(ModelCamera(number, name, height, width, cursor.read(f"{count}d")))
    return cameras


def _binary_images(file: Path) -> list[ModelImage]:
    images = []
    with _cursor(file) as cursor:
        for _ in range(*cursor.read("Q")):
            _number, *pose, camera = cursor.read("i7di")
            images.append(ModelImage(cursor.read_name(), camera, tuple(pose[:4]), tuple(pose[4:])))
            (points,) = cursor.read("Q")
            cursor.at += points * _POINT_2D_BYTES
    return images


def _text_cameras(file: Path) -> list[ModelCamera]:
    """`CAMERA_ID MODEL WIDTH HEIGHT PARAMS…` on each line."""
    cameras = []
    for number, line in _lines(file):
        if not line.strip():
            continue
        fields = line.split()
        try:
            identity = int(fields[0])
        except ValueError:
            raise InputError(_malformed(file, number)) from None
        try:
            model, width, height, *parameters = fields[1:]
            numbers = tuple(map(float, parameters))
            cameras.append(ModelCamera(identity, model, int(height), int(width), numbers))
        except ValueError:
            cameras.append(ModelCamera(identity, "", 0, 0, (), _malformed(file, number)))
    return cameras


def _text_images(file: Path) -> list[ModelImage]:
    """`ID QW QX QY QZ TX TY TZ CAMERA_ID NAME` on one line, on the next its points or nothing."""
    images: list[ModelImage] = []
    is_image, blank_at = True, 0
    for number, line in _lines(file):
        fields = line.split(maxsplit=9)  # a name may hold spaces
        if not is_image and len(fields) == 10 and not _is_number(fields[9].split()[0]):
            raise InputError(
                f"{file}: line {number} is an image where the points of the one before are "
                "expected, on a line that may be empty; export the model again"
            )
        if not is_image:
            is_image = True
        elif not fields:  # allowed before the first image and after the last
            blank_at = number if images else 0
        elif blank_at:
            raise InputError(_malformed(file, blank_at))
        else:
            try:
                pose = tuple(map(float, fields[1:8]))
                images.append(ModelImage(fields[9].strip(), int(fields[8]), pose[:4], pose[4:]))
            except (IndexError, ValueError):
                name = fields[9].strip() if len(fields) == 10 else ""
                images.append(ModelImage(name, 0, (), (), _malformed(file, number)))
            is_image = False
    return images


def _is_number(word: str) -> bool:
    """Points are triples of numbers, so their tenth word is a number; an image's is its name."""
    try:
        float(word)
    except ValueError:
        return False
    return True


def _lines(file: Path) -> Iterator[tuple[int, str]]:
    """Numbered lines without the comments, one at a time."""
    number = 0
    try:
        with file.open(encoding="utf-8-sig", errors="surrogateescape") as stream:
            while line := stream.readline(_MAX_LINE_CHARACTERS):
                number += 1
                if len(line) == _MAX_LINE_CHARACTERS:
                    raise InputError(f"{file}: line {number} has no end; export the model again")
                if not line.startswith("#"):
                    yield number, line
    except OSError as error:
        raise InputError(f"{file}: cannot be read ({error.strerror}); check the file") from None


def _malformed(file: Path, number: int) -> str:
    return f"{file}: line {number} is malformed; export the model again"
