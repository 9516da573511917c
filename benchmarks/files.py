"""Files as results are written and read: JSON of the same bytes for the same content, pictures,
clouds.
"""

import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image
from plyfile import PlyData, PlyParseError
from torch import Tensor

from extrap_train.data.images import ARRAY_ERRORS, to_eight_bits
from extrap_train.data.picture_files import DECODER_ERRORS, is_readable_size
from extrap_train.errors import InputError


def json_bytes(content: Any) -> bytes:
    """Indented, with a last line end; NaN is refused, since JSON has none."""
    return (json.dumps(content, indent=1, allow_nan=False) + "\n").encode()


def png_bytes(image: Float[Tensor, "3 h w"]) -> bytes:
    """An image in [0, 1] as an 8-bit PNG."""
    content = io.BytesIO()
    Image.fromarray(to_eight_bits(image.permute(1, 2, 0))).save(content, "png")
    return content.getvalue()


def images_of(pictures: Mapping[str, bytes]) -> Float[Tensor, "n 3 h w"]:
    """Images of one size from the contents of PNG files, by name: 8 bits there, here in [0, 1]."""
    arrays = [_decode_png(name, content) for name, content in pictures.items()]
    if len({array.shape for array in arrays}) != 1:
        raise InputError(f"{', '.join(pictures)}: expected images of one size; make the cell again")
    return torch.from_numpy(np.stack(arrays)).permute(0, 3, 1, 2).float() / 255


def _decode_png(name: str, content: bytes) -> UInt8[np.ndarray, "h w 3"]:
    try:
        picture = Image.open(io.BytesIO(content), formats=("PNG",))
        if picture.mode == "RGB" and is_readable_size(picture):
            return np.array(picture)
    except DECODER_ERRORS:
        pass
    raise InputError(f"{name}: is no PNG picture in 8-bit RGB; make the cell again")


def npy_bytes(values: Tensor) -> bytes:
    """An array in single precision."""
    content = io.BytesIO()
    np.save(content, values.float().numpy())
    return content.getvalue()


def array_of(content: bytes) -> Tensor:
    """The array that a file of `npy_bytes` holds."""
    try:
        array = np.lib.format.read_array(io.BytesIO(content), allow_pickle=False)
        return torch.from_numpy(array.astype(np.float32, copy=False))
    except ARRAY_ERRORS as error:
        raise InputError(
            f"an array of a result is damaged ({error}); make its cell again"
        ) from None


def read_points(path: Path) -> Float[Tensor, "m 3"]:
    """The points of a PLY file."""
    try:
        vertices = PlyData.read(path)["vertex"]
        columns = [np.asarray(vertices[axis], np.float32) for axis in ("x", "y", "z")]
    except (OSError, PlyParseError, KeyError, ValueError) as error:
        raise InputError(f"{path}: no points can be read ({error}); restore the file") from None
    return torch.from_numpy(np.stack(columns, 1))
