"""COLMAP's `cameras.bin` and `images.bin` (little-endian); no size they state is trusted."""

import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, NoReturn

from extrap_train.data.colmap_records import PARAMETERS, ModelCamera, ModelImage
from extrap_train.data.paths import MAX_PATH_BYTES
from extrap_train.errors import InputError

POINT_2D_BYTES = 24
"""x, y and the number of the point in space, 8 bytes each."""


class _Cursor:
    """Walks through a file; running past its end is an InputError. Points are never in memory."""

    def __init__(self, stream: IO[bytes], file: Path) -> None:
        self.stream, self.file = stream, file
        self.length = os.fstat(stream.fileno()).st_size

    def read(self, layout: str) -> tuple[Any, ...]:
        content = self.stream.read(struct.calcsize("<" + layout))
        if len(content) < struct.calcsize("<" + layout):
            self._truncated()
        return struct.unpack("<" + layout, content)

    def skip(self, size: int) -> None:
        if size > self.length - self.stream.tell():
            self._truncated()
        self.stream.seek(size, os.SEEK_CUR)

    def read_name(self) -> str:
        start = self.stream.tell()
        name, end, _ = self.stream.read(MAX_PATH_BYTES + 1).partition(b"\0")
        if not end:
            self._truncated()
        self.stream.seek(start + len(name) + 1)
        try:
            return name.decode()
        except UnicodeDecodeError:
            raise InputError(
                f"{self.file}: has a picture name that is not UTF-8; export the model again"
            ) from None

    def _truncated(self) -> NoReturn:
        raise InputError(f"{self.file}: is truncated or damaged; export the model again")


def count_binary_images(file: Path) -> int:
    """How many images an `images.bin` says it has."""
    with _opened(file) as cursor:
        return int(cursor.read("Q")[0])


def read_binary_cameras(file: Path) -> list[ModelCamera]:
    """Every camera of a `cameras.bin`."""
    cameras = []
    with _opened(file) as cursor:
        (count,) = cursor.read("Q")
        for _ in range(count):
            number, model, width, height = cursor.read("iiQQ")
            if model not in PARAMETERS:
                raise InputError(
                    f"{file}: camera {number} is of a model that has the number {model}, and the "
                    "models known here end at 17; run COLMAP's image_undistorter first"
                )
            parameters = cursor.read(f"{PARAMETERS[model]}d")
            cameras.append(ModelCamera(number, model, height, width, parameters))
    return cameras


def read_binary_images(file: Path) -> list[ModelImage]:
    """Every image of an `images.bin`; the points that it shows are skipped."""
    images = []
    with _opened(file) as cursor:
        (count,) = cursor.read("Q")
        for _ in range(count):
            _number, *pose, camera = cursor.read("i7di")
            name = cursor.read_name()
            (points,) = cursor.read("Q")
            cursor.skip(points * POINT_2D_BYTES)
            images.append(ModelImage(name, camera, tuple(pose[:4]), tuple(pose[4:])))
    return images


@contextmanager
def _opened(file: Path) -> Iterator[_Cursor]:
    with file.open("rb") as stream:
        yield _Cursor(stream, file)
