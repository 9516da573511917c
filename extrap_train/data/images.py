"""Photographs, masks and depth maps on disk to tensors, each checked against its annotated size."""

import operator
import tokenize
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Shaped, UInt8
from PIL import Image
from torch import Tensor

from extrap_train.data.paths import require_file
from extrap_train.data.picture_files import MAX_PIXELS, read_turned, same_view
from extrap_train.errors import InputError

BACKGROUND = 255
"""What a photograph shows where it is transparent: white, whatever colour is hidden there."""
ARRAY_ERRORS = (
    *(OSError, EOFError, ValueError, TypeError, SyntaxError, ArithmeticError),
    *(RecursionError, MemoryError, tokenize.TokenError),
)
"""What NumPy raises on damaged NPY files."""
MAX_DEPTH_SCALE = 1e6
"""Scene units per unit of a depth file; a larger one is damage."""

_EIGHT_BIT_MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "CMYK", "YCbCr")
_SIXTEEN_BIT_MODES = ("I;16", "I;16B")
_DEPTH_MODES = (*_SIXTEEN_BIT_MODES, "I", "F")


def read_photograph(
    path: Path, size: tuple[int, int], mask_path: Path | None = None
) -> tuple[Float[Tensor, "3 h w"], Float[Tensor, "h w"] | None]:
    """A photograph of `size` (height, width), colours in [0, 1], and its object mask in [0, 1].

    The picture is turned by its EXIF orientation where only then it has that size. Where it is
    transparent it shows `BACKGROUND` and no object, whatever the mask file says. There is no mask
    where the picture is opaque and has no mask file.
    """
    picture = _require_mode(read_turned(path, size, operator.eq), _EIGHT_BIT_MODES, path)
    alpha = None
    if picture.has_transparency_data:
        picture = picture.convert("RGBA")
        alpha = np.array(picture.getchannel("A"))
        white = Image.new("RGBA", picture.size, (BACKGROUND, BACKGROUND, BACKGROUND, 255))
        picture = Image.alpha_composite(white, picture)
    pixels = np.array(picture.convert("RGB"))
    image = torch.from_numpy(pixels).permute(2, 0, 1).contiguous().float().div_(255)
    mask = read_mask(mask_path, size) if mask_path else None
    if alpha is not None and (alpha < 255).any():
        opaque = torch.from_numpy(alpha).float().div_(255)
        mask = opaque if mask is None else opaque * mask
        if not mask.any():
            raise InputError(
                f"{path}: is transparent wherever its mask shows the object; correct the file or "
                "remove its entry"
            )
    return image, mask


def to_eight_bits(values: Float[Tensor, "..."]) -> UInt8[np.ndarray, "..."]:
    """Values in [0, 1], those beyond clipped, as bytes."""
    return values.detach().cpu().clamp(0, 1).mul(255).round().to(torch.uint8).numpy()


def read_mask(path: Path, size: tuple[int, int]) -> Float[Tensor, "h w"]:
    """An object mask in [0, 1]; one without any object is an error.

    A mask of the same shape as `size` is resampled to it. One of 0 and 1 alone means black and
    white.
    """
    pixels = _read_mask(path, size)
    if not pixels.any():
        raise InputError(f"{path}: the mask is black everywhere; remove it or its frame")
    return torch.from_numpy(pixels).float().div_(1 if pixels.max() == 1 else 255)


def read_depth_mask(path: Path, size: tuple[int, int]) -> Float[Tensor, "h w"]:
    """1 where the depth of a pixel is to be trusted, else 0; may be 0 everywhere."""
    return torch.from_numpy(_read_mask(path, size) > 0).float()


def read_sixteen_bit(path: Path, size: tuple[int, int]) -> Shaped[np.ndarray, "h w"]:
    """The raw values, uint16, of a greyscale PNG of 16 bits a pixel, resampled to `size`."""
    picture = _require_mode(read_turned(path, size, same_view), _SIXTEEN_BIT_MODES, path)
    return _nearest(np.asarray(picture).astype(np.uint16), size)


def read_depth(path: Path, size: tuple[int, int], scale: float) -> Float[Tensor, "h w"]:
    """A depth map, times `scale`: greyscale of 16 bits, a TIFF of 32, or an NPY array.

    0 is unknown. A map of the same shape as `size` is resampled to it, from the nearest pixels.
    """
    if path.suffix.lower() == ".npy":
        raw = _read_npy(path, size)
    else:
        raw = np.asarray(_require_mode(read_turned(path, size, same_view), _DEPTH_MODES, path))
    return known_depth(_nearest(raw, size), scale, path)


def known_depth(raw: Shaped[np.ndarray, "h w"], scale: float, path: Path) -> Float[Tensor, "h w"]:
    """`raw` × `scale`, 0 where that is not positive and finite.

    An empty map, and a scale that cannot be, is an error that names `path`.
    """
    if not 0 < scale < MAX_DEPTH_SCALE:
        raise InputError(
            f"{path}: the scale of its depth is {scale}, no possible one; correct its entry or "
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


def _read_mask(path: Path, size: tuple[int, int]) -> UInt8[np.ndarray, "h w"]:
    """Grey values; what is transparent is black."""
    picture = _require_mode(read_turned(path, size, same_view), _EIGHT_BIT_MODES, path)
    if picture.has_transparency_data:
        picture = picture.convert("RGBA")
        black = Image.new("RGBA", picture.size, (0, 0, 0, 255))
        picture = Image.alpha_composite(black, picture)
    return _nearest(np.array(picture.convert("L")), size)


def _read_npy(path: Path, size: tuple[int, int]) -> Shaped[np.ndarray, "h w"]:
    require_file(path)
    try:
        # Mapped, not read: the header may promise any size.
        raw: np.ndarray = np.lib.format.open_memmap(path, mode="r")
    except ARRAY_ERRORS as error:
        raise InputError(f"{path}: is no array of numbers ({error}); restore it") from None
    if raw.ndim == 3 and raw.shape[2] == 1:
        raw = raw[..., 0]
    fits = raw.ndim == 2 and 0 < raw.size <= MAX_PIXELS and same_view(raw.shape, size)
    if not fits or raw.dtype.kind not in "fiu":
        raise InputError(
            f"{path}: is an array of {raw.dtype} {raw.shape}, expected numbers {size}; restore it"
        )
    return np.asarray(raw)


def _nearest(pixels: Shaped[np.ndarray, "h w"], size: tuple[int, int]) -> Shaped[np.ndarray, "a b"]:
    """Resampled to `size`, (height, width), without mixing values."""
    if pixels.shape == size:
        return pixels
    rows, columns = (
        ((np.arange(wanted) + 0.5) * (given / wanted)).astype(int)
        for wanted, given in zip(size, pixels.shape, strict=True)
    )
    return pixels[rows[:, None], columns]


def _require_mode(picture: Image.Image, modes: tuple[str, ...], path: Path) -> Image.Image:
    if picture.mode not in modes:
        raise InputError(
            f"{path}: has pixels of kind {picture.mode}, expected one of {', '.join(modes)}; "
            "convert the file"
        )
    return picture
