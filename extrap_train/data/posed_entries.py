"""Entries of one picture each in the terms of a `transforms.json`, to photographs.

Readers of other programs' cameras write such entries, and need not know what a sound one is.
"""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.data.image_files import MAX_PIXELS, image_size
from extrap_train.data.lens_keys import lens_of, number_of
from extrap_train.data.listed_photographs import ListedPhotograph
from extrap_train.errors import InputError
from extrap_train.geometry.foreign_cameras import world_to_cam_from_opengl

MILLIMETRES = 0.001
"""The unit of most depth files, in metres."""
LAST_ROW_TOLERANCE = 1e-6
"""Tolerance on a matrix's last row, relative to its last number."""


def photograph_of_entry(root: Path, entry: dict[str, Any], path: str) -> ListedPhotograph:
    """The picture at `path` below `root` with its size, lens and pose; no depth and no mask.

    `transform_matrix` is camera-to-world with OpenGL axes. Raises KeyError, ValueError and others
    that `names_faults` turns into InputError.
    """
    height, width = _size(root / path, entry)
    return ListedPhotograph(
        image_path=path,
        height=height,
        width=width,
        lens=lens_of(entry, height, width),
        world_to_cam=world_to_cam_from_opengl(_rigid(entry["transform_matrix"])),
    )


@contextmanager
def names_faults(file: Path, path: str) -> Iterator[None]:
    """InputError that names the `file` and its entry of the picture at `path` where that is bad."""
    try:
        yield
    except KeyError as error:
        raise InputError(
            f"{file}: neither the file nor its entry {path} has {error}; add it"
        ) from None
    except InputError:
        raise
    except (TypeError, ValueError, OverflowError, RuntimeError) as error:
        raise InputError(f"{file}: entry {path} is malformed ({error}); correct it") from None


def _size(picture: Path, entry: dict[str, Any]) -> tuple[int, int]:
    if "h" not in entry and "w" not in entry:
        return image_size(picture)
    height, width = number_of(entry, "h"), number_of(entry, "w")
    if not (height >= 1 and width >= 1 and height * width <= MAX_PIXELS):
        raise ValueError(f"image size {height:g} x {width:g}")
    return int(height), int(width)


def _rigid(rows: Any) -> Float[Tensor, "4 4"]:
    """A matrix of a file, without the scale that its last row or its axes may have."""
    try:
        matrix = torch.tensor(rows, dtype=torch.float64)
    except (TypeError, ValueError, OverflowError, RuntimeError):
        said = json.dumps(rows)[:60]
        raise ValueError(f"transform_matrix is {said}, expected 4 x 4 numbers") from None
    if matrix.shape not in ((4, 4), (3, 4)):
        raise ValueError(f"transform_matrix has shape {tuple(matrix.shape)}, expected 4 x 4")
    if len(matrix) == 4:
        *last, scale = matrix[3].tolist()
        if scale == 0 or max(map(abs, last)) > LAST_ROW_TOLERANCE * abs(scale):
            raise ValueError(
                f"the last row of transform_matrix is {matrix[3].tolist()}, expected 0, 0, 0, 1: "
                "is the matrix transposed (column-major)?"
            )
        matrix = matrix / scale
    rotation = matrix[:3, :3]
    size = torch.linalg.det(rotation).abs() ** (1 / 3)
    rigid = torch.eye(4, dtype=torch.float64)
    rigid[:3, :3] = rotation / size
    rigid[:3, 3] = matrix[:3, 3]
    return rigid
