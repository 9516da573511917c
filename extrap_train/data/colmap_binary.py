"""COLMAP's `cameras.bin` and `images.bin` (little-endian); no size they state is trusted."""

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from extrap_train.data.colmap_records import (
    ModelCamera,
    ModelImage,
    find_camera_model,
    make_camera,
)
from extrap_train.errors import InputError

POINT_2D_BYTES = 24
"""x, y and the number of the point in space, 8 bytes each."""


@dataclass
class _Cursor:
    """Walks through a file's content; running past its end is an InputError."""

    content: bytes
    file: Path
    position: int = 0

    def read(self, layout: str) -> tuple[Any, ...]:
        size = struct.calcsize("<" + layout)
        self.skip(size)
        return struct.unpack_from("<" + layout, self.content, self.position - size)

    def skip(self, size: int) -> None:
        self.position += size
        if self.position > len(self.content):
            self._truncated()

    def read_name(self) -> str:
        end = self.content.find(b"\0", self.position)
        if end < 0:
            self._truncated()
        name = self.content[self.position : end]
        self.position = end + 1
        try:
            return name.decode()
        except UnicodeDecodeError:
            raise InputError(
                f"{self.file}: has a picture name that is not UTF-8; export the model again"
            ) from None

    def _truncated(self) -> None:
        raise InputError(f"{self.file}: is truncated or damaged; export the model again")


def read_binary_cameras(file: Path) -> list[ModelCamera]:
    """Every camera of a `cameras.bin`."""
    cursor = _Cursor(file.read_bytes(), file)
    (count,) = cursor.read("Q")
    cameras = []
    for _ in range(count):
        number, model_number, width, height = cursor.read("iiQQ")
        model = find_camera_model(model_number, file)
        values = cursor.read(f"{len(model.parameters)}d")
        cameras.append(make_camera(number, model, height, width, values, file))
    return cameras


def read_binary_images(file: Path) -> list[ModelImage]:
    """Every image of an `images.bin`; the points that it shows are skipped."""
    cursor = _Cursor(file.read_bytes(), file)
    (count,) = cursor.read("Q")
    images = []
    for _ in range(count):
        _number, *pose, camera = cursor.read("i7di")
        name = cursor.read_name()
        (points,) = cursor.read("Q")
        cursor.skip(points * POINT_2D_BYTES)
        images.append(ModelImage(name, camera, tuple(pose[:4]), tuple(pose[4:])))
    return images
