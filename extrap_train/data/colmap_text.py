"""COLMAP's `cameras.txt` and `images.txt`."""

from collections.abc import Iterator
from pathlib import Path

from extrap_train.data.colmap_records import (
    ModelCamera,
    ModelImage,
    find_camera_model,
    make_camera,
)
from extrap_train.errors import InputError


def read_text_cameras(file: Path) -> list[ModelCamera]:
    """Every camera of a `cameras.txt`: `CAMERA_ID MODEL WIDTH HEIGHT PARAMS…` a line."""
    cameras = []
    for number, line in _lines(file):
        fields = line.split()
        if not fields:
            continue
        try:
            identity, width, height = int(fields[0]), int(fields[2]), int(fields[3])
            values = [float(field) for field in fields[4:]]
        except (IndexError, ValueError):
            raise _malformed(file, number) from None
        model = find_camera_model(fields[1], file)
        cameras.append(make_camera(identity, model, height, width, values, file))
    return cameras


def read_text_images(file: Path) -> list[ModelImage]:
    """Every image of an `images.txt`: `ID QW QX QY QZ TX TY TZ CAMERA_ID NAME`, two lines each.

    The second line lists the points that the image shows and may be empty.
    """
    lines = list(_lines(file))
    while lines and not lines[0][1].strip():
        lines.pop(0)
    while lines and not lines[-1][1].strip():
        lines.pop()
    images = []
    for number, line in lines[1::2]:
        if _is_image(line):
            raise InputError(
                f"{file}: line {number} is an image where the points of the one before are "
                "expected, on a line that may be empty; export the model again"
            )
    for number, line in lines[::2]:
        # A name may hold spaces.
        fields = line.split(maxsplit=9)
        try:
            pose = tuple(float(field) for field in fields[1:8])
            camera, name = int(fields[8]), fields[9].strip()
        except (IndexError, ValueError):
            raise _malformed(file, number) from None
        images.append(ModelImage(name, camera, pose[:4], pose[4:]))
    return images


def _is_image(line: str) -> bool:
    """Points are triples of numbers, so their tenth word is a number; an image's is its name."""
    fields = line.split(maxsplit=9)
    return len(fields) == 10 and not _is_number(fields[9].split()[0])


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _lines(file: Path) -> Iterator[tuple[int, str]]:
    """Numbered lines without the comments."""
    try:
        content = file.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise InputError(f"{file}: is no UTF-8 text; export the model again") from None
    for number, line in enumerate(content.splitlines(), start=1):
        if not line.startswith("#"):
            yield number, line


def _malformed(file: Path, number: int) -> InputError:
    return InputError(f"{file}: line {number} is malformed; export the model again")
