"""COLMAP's `cameras.txt` and `images.txt`."""

from collections.abc import Iterator
from itertools import dropwhile
from pathlib import Path

from extrap_train.data.colmap_records import ModelCamera, ModelImage
from extrap_train.errors import InputError

MAX_LINE_CHARACTERS = 2**24
"""A line of points takes about twenty for each."""


def count_text_images(file: Path) -> int:
    """How many images an `images.txt` has: about, where it is damaged."""
    return (sum(1 for _ in _lines(file)) + 1) // 2


def read_text_cameras(file: Path) -> list[ModelCamera]:
    """Every camera of a `cameras.txt`: `CAMERA_ID MODEL WIDTH HEIGHT PARAMS…` a line."""
    cameras = []
    for number, line in _lines(file):
        fields = line.split()
        if not fields:
            continue
        try:
            identity, width, height = int(fields[0]), int(fields[2]), int(fields[3])
            parameters = tuple(float(field) for field in fields[4:])
        except (IndexError, ValueError):
            raise _malformed(file, number) from None
        cameras.append(ModelCamera(identity, fields[1], height, width, parameters))
    return cameras


def read_text_images(file: Path) -> list[ModelImage]:
    """Every image of an `images.txt`: `ID QW QX QY QZ TX TY TZ CAMERA_ID NAME`, two lines each.

    The second line lists the points that the image shows and may be empty.
    """
    images: list[ModelImage] = []
    is_image, blank = True, 0
    for number, line in dropwhile(lambda numbered: not numbered[1].strip(), _lines(file)):
        if not is_image and _is_image(line):
            raise InputError(
                f"{file}: line {number} is an image where the points of the one before are "
                "expected, on a line that may be empty; export the model again"
            )
        if is_image and line.strip():
            if blank:
                raise _malformed(file, number - 1)
            images.append(_image(line, number, file))
        elif is_image:  # allowed at the end alone
            blank += 1
            continue
        is_image = not is_image
    return images


def _image(line: str, number: int, file: Path) -> ModelImage:
    # A name may hold spaces.
    fields = line.split(maxsplit=9)
    try:
        pose = tuple(float(field) for field in fields[1:8])
        return ModelImage(fields[9].strip(), int(fields[8]), pose[:4], pose[4:])
    except (IndexError, ValueError):
        raise _malformed(file, number) from None


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
    """Numbered lines without the comments, one at a time."""
    number = 0
    try:
        with file.open(encoding="utf-8-sig") as stream:
            while line := stream.readline(MAX_LINE_CHARACTERS):
                number += 1
                if len(line) == MAX_LINE_CHARACTERS:
                    raise InputError(f"{file}: line {number} has no end; export the model again")
                if not line.startswith("#"):
                    yield number, line
    except UnicodeDecodeError:
        raise InputError(f"{file}: is no UTF-8 text; export the model again") from None
    except OSError as error:
        raise InputError(f"{file}: cannot be read ({error.strerror}); check the file") from None


def _malformed(file: Path, number: int) -> InputError:
    return InputError(f"{file}: line {number} is malformed; export the model again")
