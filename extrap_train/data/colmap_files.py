"""The files of COLMAP's sparse models, text and binary: cameras, images, points."""

import mmap
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from extrap_train.data.paths import MAX_PATH_BYTES
from extrap_train.errors import InputError
from extrap_train.geometry.foreign_cameras import NAMES_AND_COUNTS

_MAX_LINE_CHARACTERS = 2**24
"""A line of points takes about twenty for each."""
_OBSERVATION = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<i8")])
_OBSERVATIONS_READ, _OBSERVATIONS_KEPT = 2048, 64
"""Of one image: enough to tell whether its pose is right."""
_CHARACTERS_OF_OBSERVATIONS = 2**17
_POINTS_READ = 2**18
_LARGEST_NUMBER = np.iinfo(np.int64).max

_Observations = tuple[tuple[float, float, int], ...]


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
    observed: _Observations = ()
    """Column, row and number of the point in space of some points that it shows, in pixels of its
    camera."""
    fault: str = ""
    """What is wrong with its entry, which then says nothing but the name, if that."""


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
            name, (points,) = cursor.read_name(), cursor.read("Q")
            read = min(points, _OBSERVATIONS_READ) * _OBSERVATION.itemsize
            block = cursor.content[cursor.at : cursor.at + read]
            cursor.at += points * _OBSERVATION.itemsize
            if len(block) == read:  # else it is the last image and damaged, which is said below
                seen = _evenly(np.frombuffer(block, _OBSERVATION).tolist())
                images.append(ModelImage(name, camera, tuple(pose[:4]), tuple(pose[4:]), seen))
    return images


def _evenly(observed: Sequence[tuple[float, float, int]]) -> _Observations:
    """Some of those of a point in space, which the number -1 says there is not."""
    of_points = [one for one in observed if 0 <= one[2] <= _LARGEST_NUMBER]
    return tuple(of_points[:: max(1, len(of_points) // _OBSERVATIONS_KEPT)])


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
            images[-1] = replace(images[-1], observed=_text_observations(line))
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
                images.append(ModelImage(name, 0, (), (), fault=_malformed(file, number)))
            is_image = False
    return images


def _text_observations(line: str) -> _Observations:
    """`X Y POINT3D_ID` for each point; none of a line that makes no sense."""
    words = line[:_CHARACTERS_OF_OBSERVATIONS].split()
    if len(line) > _CHARACTERS_OF_OBSERVATIONS:
        words.pop()  # may have been cut
    try:
        triples = zip(words[::3], words[1::3], words[2::3], strict=False)
        return _evenly([(float(x), float(y), int(point)) for x, y, point in triples])
    except ValueError:
        return ()


def read_model_points(
    model: Path,
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
    """Numbers, each once and in order, and places of a model's points in space: of the first
    262,144 in `points3D.bin`, else `points3D.txt`, those that are finite; none where there is
    neither file. Raises InputError that names a damaged one.
    """
    kinds = {"bin": _binary_points, "txt": _text_points}
    files = {kind: model / f"points3D.{kind}" for kind in kinds}
    kind = next((kind for kind, file in files.items() if file.is_file()), None)
    found = kinds[kind](files[kind]) if kind else []
    numbers, first = np.unique(np.array([row[0] for row in found], np.int64), return_index=True)
    places = np.array([row[1:] for row in found], np.float64).reshape(-1, 3)[first]
    finite = np.isfinite(places).all(1)
    return numbers[finite], places[finite]


def _binary_points(file: Path) -> list[tuple[float, ...]]:
    found = []
    with _cursor(file) as cursor:
        for _ in range(min(*cursor.read("Q"), _POINTS_READ)):
            *point, length = cursor.read("q3d11xQ")  # skips colour and error
            cursor.at += 8 * length
            found.append(tuple(point))
    return found


def _text_points(file: Path) -> list[tuple[float, ...]]:
    """`POINT3D_ID X Y Z …` on each line."""
    found: list[tuple[float, ...]] = []
    for number, line in islice(_lines(file), _POINTS_READ):
        if fields := line.split(maxsplit=4):
            try:
                point, x, y, z = int(fields[0]), *map(float, fields[1:4])
            except ValueError:
                raise InputError(_malformed(file, number)) from None
            if 0 <= point <= _LARGEST_NUMBER:
                found.append((point, x, y, z))
    return found


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
