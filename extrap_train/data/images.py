"""Photographs and masks on disk to tensors, each checked against its annotated size."""

import operator
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Shaped, UInt8
from PIL import Image
from torch import Tensor

from extrap_train.data.picture_files import read_turned, same_view
from extrap_train.errors import InputError

BACKGROUND = 255
"""What a photograph shows where it is transparent: white, whatever colour is hidden there."""
_EIGHT_BIT_MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "CMYK", "YCbCr")


def read_photograph(
    path: Path, size: tuple[int, int], mask_path: Path | None = None, upright: bool = False
) -> tuple[Float[Tensor, "3 h w"], Float[Tensor, "h w"] | None]:
    """A photograph of `size` (height, width), colours in [0, 1], and its object mask in [0, 1].

    The picture is turned by its EXIF orientation where only then it has that size, or if `upright`
    where it has that size then. Where it is transparent it shows `BACKGROUND` and no object,
    whatever the mask file says. There is no mask where the picture is opaque and has no mask file.
    """
    picture = require_mode(read_turned(path, size, operator.eq, upright), _EIGHT_BIT_MODES, path)
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
    pixels = read_grey(path, size)
    if not pixels.any():
        raise InputError(f"{path}: the mask is black everywhere; remove it or its frame")
    return torch.from_numpy(pixels).float().div_(1 if pixels.max() == 1 else 255)


def read_grey(path: Path, size: tuple[int, int]) -> UInt8[np.ndarray, "h w"]:
    """Grey values; what is transparent is black."""
    picture = require_mode(read_turned(path, size, same_view), _EIGHT_BIT_MODES, path)
    if picture.has_transparency_data:
        picture = picture.convert("RGBA")
        black = Image.new("RGBA", picture.size, (0, 0, 0, 255))
        picture = Image.alpha_composite(black, picture)
    return nearest_pixels(np.array(picture.convert("L")), size)


def nearest_pixels(
    pixels: Shaped[np.ndarray, "h w"], size: tuple[int, int]
) -> Shaped[np.ndarray, "a b"]:
    """Resampled to `size`, (height, width), without mixing values."""
    if pixels.shape == size:
        return pixels
    rows, columns = (
        ((np.arange(wanted) + 0.5) * (given / wanted)).astype(int)
        for wanted, given in zip(size, pixels.shape, strict=True)
    )
    return pixels[rows[:, None], columns]


def require_mode(picture: Image.Image, modes: tuple[str, ...], path: Path) -> Image.Image:
    """The picture, if its pixels are of one of Pillow's `modes`; InputError otherwise."""
    if picture.mode not in modes:
        raise InputError(
            f"{path}: has pixels of kind {picture.mode}, expected one of {', '.join(modes)}; "
            "convert the file"
        )
    return picture
