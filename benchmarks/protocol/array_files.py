"""Files of results, as they are written and read: what is read may come from elsewhere, and is
refused before memory is asked for.
"""

import hashlib
import io
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image
from plyfile import PlyData, PlyParseError
from pydantic import AfterValidator, Field
from torch import Tensor

from extrap_train.data.depth_files import ARRAY_ERRORS
from extrap_train.data.image_files import DECODER_ERRORS
from extrap_train.errors import InputError

MAX_POINTS = 50_000_000
_MAX_BYTES = 2**30
_PLY_HEADER_BYTES = 2**16
_COUNTS = re.compile(rb"^element\s+\S+\s+(\d+)", re.MULTILINE)


def _file_name(value: str) -> str:
    if Path(value).name != value or value in ("", "..") or "\0" in value:
        raise ValueError("must be the name of a file")
    return value


def _inner_path(value: str) -> str:
    return "/".join(map(_file_name, value.split("/")))


FileName = Annotated[str, AfterValidator(_file_name)]
InnerPath = Annotated[str, AfterValidator(_inner_path)]
Number = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(ge=0, allow_inf_nan=False)]


def sha256_of(file: Path) -> str | None:
    """SHA-256 of a file's content; None if it does not exist or is larger than any of ours."""
    if not _is_usual(file):
        return None
    with file.open("rb") as content:
        return hashlib.file_digest(content, "sha256").hexdigest()


def read_limited(file: Path) -> bytes:
    """A file's content; raises InputError where it is missing or larger than any of ours."""
    if not _is_usual(file):
        raise InputError(f"{file}: is missing, or larger than any such file; restore it")
    return file.read_bytes()


def _is_usual(file: Path) -> bool:
    return file.is_file() and file.stat().st_size <= _MAX_BYTES


def pictures_of(pictures: Mapping[Path, bytes], side: int) -> Float[Tensor, "n 3 side side"]:
    """The pictures in files of `png_bytes`, colours in [0, 1]; InputError for any others."""
    pixels = [_decode(content, side, file) for file, content in pictures.items()]
    return torch.from_numpy(np.stack(pixels)).permute(0, 3, 1, 2).float() / 255


def _decode(content: bytes, side: int, file: Path) -> UInt8[np.ndarray, "side side 3"]:
    try:
        with Image.open(io.BytesIO(content), formats=("PNG",)) as picture:
            if (picture.size, picture.mode) != ((side, side), "RGB"):
                raise InputError(
                    f"{file}: is a picture of {picture.width} × {picture.height} px and mode "
                    f"{picture.mode}, not of {side} × {side} and RGB; run the table again"
                )
            return np.array(picture)
    except InputError:
        raise
    except DECODER_ERRORS:
        raise InputError(f"{file}: is not a PNG picture; run the table again") from None


def npy_bytes(values: Tensor) -> bytes:
    """An array in single precision."""
    content = io.BytesIO()
    np.save(content, values.float().numpy())
    return content.getvalue()


def array_of(content: bytes, shape: tuple[int | None, ...], file: Path) -> Tensor:
    """The array in a file of `npy_bytes`, of this shape, where None is any length.

    Raises InputError for any other content, and for numbers that are not finite.
    """
    stream = io.BytesIO(content)
    try:
        version = np.lib.format.read_magic(stream)
        if version != (1, 0):
            raise ValueError("another version of the format")
        found, is_fortran, dtype = np.lib.format.read_array_header_1_0(stream)
        rest = len(content) - stream.tell()
        fits = len(found) == len(shape) and all(
            want in (None, have) for want, have in zip(shape, found, strict=True)
        )
        if dtype != np.float32 or is_fortran or not fits or rest != 4 * math.prod(found):
            raise ValueError(f"{dtype} of shape {found}")
    except ARRAY_ERRORS as error:
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"{file}: is not such an array ({reason}); run the table again") from None
    values = torch.from_numpy(np.frombuffer(stream.read(), np.float32).copy())
    if not values.isfinite().all():
        raise InputError(f"{file}: holds numbers that are not finite; run the table again")
    return values.reshape(found)


def read_points(path: Path) -> Float[Tensor, "m 3"]:
    """The points of a PLY file."""
    try:
        with path.open("rb") as file:
            header = file.read(_PLY_HEADER_BYTES).partition(b"end_header")[0]
        count = max(map(int, _COUNTS.findall(header)), default=0)
        if count > min(MAX_POINTS, path.stat().st_size):
            raise ValueError(f"its header states {count:,} elements")
        vertices = PlyData.read(path)["vertex"]
        columns = [np.asarray(vertices[axis], np.float32) for axis in ("x", "y", "z")]
    except (OSError, PlyParseError, KeyError, ValueError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: no points can be read ({error}); restore the file") from None
    return torch.from_numpy(np.stack(columns, 1))
