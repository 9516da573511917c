"""Photographs, masks and depth maps on disk to tensors, each checked against its annotated size."""

import math
import struct
import warnings
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Shaped, UInt8
from PIL import Image
from torch import Tensor

from extrap_train.errors import InputError

MAX_PIXELS = 100_000_000
"""Larger than any camera's photograph; a size from outside beyond it is an error or an attack."""

_EIGHT_BIT_MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "CMYK", "YCbCr")
_SIXTEEN_BIT_MODES = ("I;16", "I;16B", "I")


def image_size(path: Path) -> tuple[int, int]:
    """(height, width) in pixels, from the file's header alone."""
    with _opened(path) as picture:
        return picture.height, picture.width


def read_image(path: Path, size: tuple[int, int]) -> Float[Tensor, "3 h w"]:
    """A photograph of `size` (height, width), colours in [0, 1]."""
    pixels = _decode(path, size, _EIGHT_BIT_MODES, "RGB")
    return torch.from_numpy(pixels).permute(2, 0, 1).contiguous().float().div_(255)


def to_eight_bits(values: Float[Tensor, "..."]) -> UInt8[np.ndarray, "..."]:
    """Values in [0, 1], those beyond clipped, as bytes."""
    return values.detach().cpu().clamp(0, 1).mul(255).round().to(torch.uint8).numpy()


def read_mask(path: Path, size: tuple[int, int]) -> Float[Tensor, "h w"]:
    """An object mask in [0, 1]; one without any object is an error."""
    mask = torch.from_numpy(_decode(path, size, _EIGHT_BIT_MODES, "L")).float().div_(255)
    if not mask.any():
        raise InputError(f"{path}: the mask is black everywhere; remove it or its frame")
    return mask


def read_depth_mask(path: Path, size: tuple[int, int]) -> Float[Tensor, "h w"]:
    """1 where the depth of a pixel is to be trusted, else 0; may be 0 everywhere."""
    return torch.from_numpy(_decode(path, size, _EIGHT_BIT_MODES, "L") > 0).float()


def read_sixteen_bit(path: Path, size: tuple[int, int]) -> Shaped[np.ndarray, "h w"]:
    """The raw values, uint16, of a greyscale PNG of 16 bits a pixel."""
    return _decode(path, size, _SIXTEEN_BIT_MODES, None).astype(np.uint16)


def known_depth(raw: Shaped[np.ndarray, "h w"], scale: float, path: Path) -> Float[Tensor, "h w"]:
    """`raw` × `scale`, 0 where that is not positive and finite.

    An empty map, and a scale that is no positive number, is an error that names `path`.
    """
    if not (math.isfinite(scale) and scale > 0):
        raise InputError(
            f"{path}: the scale of its depth is {scale}, no positive number; correct its entry or "
            "estimate depth (depth=stereo)"
        )
    with np.errstate(invalid="ignore", over="ignore"):
        depth = raw.astype(np.float32) * np.float32(scale)
    depth[~(np.isfinite(depth) & (depth > 0))] = 0
    if not depth.any():
        raise InputError(
            f"{path}: the depth map is zero everywhere; remove it or its frame, or estimate depth "
            "(depth=stereo)"
        )
    return torch.from_numpy(depth)


def _opened(path: Path) -> Image.Image:
    """The picture with its header read; refuses sizes that no camera makes."""
    try:
        with warnings.catch_warnings():
            # The limit below is stricter than what Pillow warns of.
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            picture = Image.open(path)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; restore it or remove its entry") from None
    except (OSError, SyntaxError, ValueError, struct.error, Image.DecompressionBombError):
        raise InputError(
            f"{path}: cannot be read as a picture; restore it or remove its entry"
        ) from None
    if picture.width * picture.height > MAX_PIXELS:
        raise InputError(
            f"{path}: {picture.height} x {picture.width} pixels are more than {MAX_PIXELS:,}; "
            "resize the picture or remove its entry"
        )
    return picture


def _decode(
    path: Path, size: tuple[int, int], modes: tuple[str, ...], target: str | None
) -> np.ndarray:
    with _opened(path) as picture:
        # Before decoding: a header that lies about its size must not cost memory.
        if (picture.height, picture.width) != size:
            raise InputError(
                f"{path}: is {picture.height} x {picture.width} pixels (height x width), but its "
                f"annotation says {size[0]} x {size[1]}; restore the file or correct the annotation"
            )
        if picture.mode not in modes:
            raise InputError(
                f"{path}: has pixels of kind {picture.mode}, expected one of {', '.join(modes)}; "
                "convert the file"
            )
        try:
            return np.array(picture.convert(target) if target else picture)
        except (OSError, SyntaxError, ValueError, struct.error):
            raise InputError(
                f"{path}: is truncated or damaged; restore it or remove its entry"
            ) from None
