"""Image files from outside: headers, photographs, masks, and what else is stored as a picture.

Few formats are read, nothing is decoded before its size is known, and every picture is turned the
way its camera holds it.
"""

import functools
import io
import logging
import math
import operator
import struct
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Shaped, UInt8
from PIL import Image, ImageOps
from torch import Tensor

from extrap_train.data.paths import require_file
from extrap_train.errors import InputError

FORMATS = ("BMP", "GIF", "JPEG", "PNG", "PPM", "TIFF", "WEBP")
"""What is decoded, whatever a file is called: none of these starts another program."""
MAX_PIXELS = 100_000_000
"""Larger than any camera's photograph; a size from outside beyond it is an error or an attack."""
MAX_SIDE = 65_535
"""JPEG's own limit."""
DECODER_ERRORS = (
    *(OSError, SyntaxError, ValueError, EOFError, TypeError, LookupError, ArithmeticError),
    *(struct.error, AttributeError, Image.DecompressionBombError),
)
"""What Pillow's decoders raise on damaged files."""
NO_DEPTH_16_BIT = 65_535
"""What sensors write where they measured nothing, or more than sixteen bits can say."""
BACKGROUND = 255
"""What a photograph shows where it is transparent: white, whatever colour is hidden there."""
_MIN_PURE = 0.9
"""Share of pure black and white in what a transparent picture shows that makes it a mask."""
_EIGHT_BIT_MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "CMYK", "YCbCr")
_ORIENTATION_TAG, _EXIF_TAG, _FOCAL_LENGTH_35MM_TAG = 0x0112, 0x8769, 0xA405
_QUARTER_TURNS = (5, 6, 7, 8)
_TURN_BACK = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_90,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_270,
}
"""From the upright picture to the stored one, by the EXIF orientation of the latter."""
_MAX_ROUNDING = 0.05
"""Two shapes that differ by more are never taken for one, however few pixels they have."""
_HEIC_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1")

log = logging.getLogger(__name__)
# Pillow warns of damaged EXIF and of sizes below the limit here; this module reports what matters.
warnings.filterwarnings("ignore", module=r"PIL\.")


def read_photograph(
    path: Path, size: tuple[int, int], mask_path: Path | None = None, upright: bool = False
) -> tuple[Float[Tensor, "3 h w"], Float[Tensor, "h w"] | None]:
    """A photograph of `size` (height, width), colours in [0, 1], and its object mask in [0, 1].

    The picture is turned by its EXIF orientation where only then it has that size, or if `upright`
    where it has that size then. Where it is transparent it shows `BACKGROUND` and no object,
    whatever the mask file says. There is no mask where the picture is opaque and has no mask file.
    """
    picture = read_picture(path, size, _EIGHT_BIT_MODES, upright, resize=False)
    alpha = None
    if picture.has_transparency_data:
        alpha = np.array(picture.convert("RGBA").getchannel("A"))
        picture = _on_ground(picture, BACKGROUND)
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


def read_mask(path: Path, size: tuple[int, int]) -> Float[Tensor, "h w"]:
    """An object mask in [0, 1]: white is the object, or of a cut-out what is not transparent.

    A transparent picture that is black and white but for soft edges is no cut-out: it is black
    where it is transparent. A mask of the shape of `size` is resampled to it. One of 0 and 1 alone
    means black and white. One without any object is an error, one that is all object a warning for
    each folder.
    """
    picture = read_picture(path, size, _EIGHT_BIT_MODES)
    pixels = np.array(picture.convert("L"))
    if picture.has_transparency_data:
        alpha = np.array(picture.convert("RGBA").getchannel("A"))
        shown = pixels[alpha > 0]
        is_mask = np.isin(shown, (0, 1, 255)).sum() >= _MIN_PURE * shown.size
        is_cut_out = alpha.min() < 255 and not is_mask
        pixels = alpha if is_cut_out else np.array(_on_ground(picture, 0).convert("L"))
    pixels = nearest_pixels(pixels, size)
    if not pixels.any():
        raise InputError(
            f"{path}: the mask selects nothing (black is background); correct or remove it, or "
            "remove its frame"
        )
    if pixels.min() == pixels.max():
        _warn_of_full_masks(path.parent)
    return torch.from_numpy(pixels).float().div_(1 if pixels.max() == 1 else 255)


def read_grey(path: Path, size: tuple[int, int]) -> UInt8[np.ndarray, "h w"]:
    """Grey values; what is transparent is black."""
    picture = read_picture(path, size, _EIGHT_BIT_MODES)
    if picture.has_transparency_data:
        picture = _on_ground(picture, 0)
    return nearest_pixels(np.array(picture.convert("L")), size)


def read_picture(
    path: Path,
    size: tuple[int, int],
    modes: Sequence[str],
    upright: bool = False,
    resize: bool = True,
) -> Image.Image:
    """The decoded picture, of one of Pillow's `modes`, turned by its EXIF orientation where only
    then it has `size` (height, width) or, with `resize`, the shape of `size`.

    Raises InputError where neither does. Where both do, it is turned if `upright`, else taken as it
    is stored, with one warning for each folder.
    """
    fits = same_view if resize else operator.eq
    with _open(path) as picture:
        tag = _orientation(picture)
        # Before decoding: a header that lies about its size must not cost memory.
        stored, turned = _sizes(picture, tag)
        as_turned = fits(turned, size)
        as_stored = fits(stored, size) and not (upright and as_turned)
        if not (as_stored or as_turned):
            turns = f", turned by its EXIF orientation {_text(turned)}," if turned != stored else ""
            other = "photograph has" if resize else "annotation says"
            raise InputError(
                f"{path}: is {_text(stored)} pixels (height x width){turns} but its {other} "
                f"{_text(size)}{', another shape' if resize else ''}; restore the file or correct "
                "its entry"
            )
        if tag != 1 and as_stored and as_turned:
            _warn_of_orientation(path.parent)
        try:
            picture.load()
            # Pillow turns a TIFF by itself.
            if tag != 1 and picture.format != "TIFF":
                picture = ImageOps.exif_transpose(picture)
            if tag != 1 and as_stored:
                picture = picture.transpose(_TURN_BACK[tag])
        except DECODER_ERRORS:
            raise InputError(
                f"{path}: is truncated or damaged; restore it or remove its entry"
            ) from None
    if picture.mode not in modes:
        raise InputError(
            f"{path}: has pixels of kind {picture.mode}, expected one of {', '.join(modes)}; "
            "convert the file"
        )
    return picture


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


def to_eight_bits(values: Float[Tensor, "..."]) -> UInt8[np.ndarray, "..."]:
    """Values in [0, 1], those beyond clipped, as bytes."""
    return values.detach().cpu().clamp(0, 1).mul(255).round().to(torch.uint8).numpy()


def png_bytes(pixels: Shaped[np.ndarray, "h w *c"]) -> bytes:
    """Grey values or colours as the content of a PNG."""
    content = io.BytesIO()
    Image.fromarray(pixels).save(content, "png")
    return content.getvalue()


def image_size(path: Path, annotated: tuple[int, int] | None = None) -> tuple[int, int]:
    """(height, width) in pixels, from the file's header alone.

    It is that of the turned picture where an EXIF orientation makes a quarter turn of it and
    `annotated`, the size of its camera, has the turned picture's shape. InputError where such a
    picture has no annotated size: nothing then says which way its camera holds it.
    """
    with _open(path) as picture:
        stored, turned = _sizes(picture, _orientation(picture))
    if annotated is None and stored != turned:
        raise InputError(
            f"{path}: its EXIF orientation turns it from {_text(stored)} to {_text(turned)} pixels "
            "(height x width), and no w and h say which of them its camera shows; add w and h"
        )
    if annotated is None:
        return stored
    turn = same_view(turned, annotated) and not same_view(stored, annotated)
    return turned if turn else stored


def stored_size(path: Path) -> tuple[int, int]:
    """(height, width) in pixels as they are stored, whatever the EXIF orientation."""
    with _open(path) as picture:
        return _sizes(picture, _orientation(picture))[0]


def upright_photograph(path: Path) -> tuple[tuple[int, int], float | None]:
    """(height, width) once turned by the EXIF orientation, and the focal length that EXIF tells.

    The latter in pixels, from the one that has the same angle of view on 35 mm film.
    """
    with _open(path) as picture:
        _, size = _sizes(picture, _orientation(picture))
        try:
            exif = Image.Image.getexif(picture).get_ifd(_EXIF_TAG)
            focal_mm = float(exif.get(_FOCAL_LENGTH_35MM_TAG, 0))
        except DECODER_ERRORS:
            focal_mm = 0.0
    if not 0 < focal_mm < math.inf:
        return size, None
    return size, focal_mm / math.hypot(24, 36) * math.hypot(*size)


def same_view(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether two sizes have one shape, up to a pixel of rounding in the smaller of them."""
    (height, width), (large_height, large_width) = sorted((size, other))
    scales = height / large_height, width / large_width
    rounding = min(1 / large_height + 1 / large_width, _MAX_ROUNDING * max(scales))
    return scales[1] <= 1 and abs(scales[0] - scales[1]) <= rounding


def _open(path: Path) -> Image.Image:
    """The picture with only its header read.

    Raises InputError where it is in none of the `FORMATS` (or HEIC, with the extra `heic`) or has
    more than `MAX_PIXELS`.
    """
    require_file(path)
    try:
        formats = ("HEIF",) if _is_heic(path) else FORMATS
        picture = Image.open(path, formats=formats)
    except PermissionError:
        raise InputError(f"{path}: you may not read this file; change its permissions") from None
    except InputError:
        raise
    except DECODER_ERRORS:
        raise InputError(
            f"{path}: cannot be read as a picture ({', '.join(FORMATS)}); restore or convert it, "
            "or remove its entry"
        ) from None
    width, height = picture.size
    if not (max(width, height) <= MAX_SIDE and 0 < width * height <= MAX_PIXELS):
        raise InputError(
            f"{path}: has {height} x {width} pixels, and only 1 to {MAX_PIXELS:,}, "
            f"at most {MAX_SIDE:,} a side, can be read; resize the picture or remove its entry"
        )
    return picture


def _is_heic(path: Path) -> bool:
    """Whether it is a HEIC picture, which the extra `heic` reads; InputError without that."""
    with path.open("rb") as file:
        start = file.read(12)
    if start[4:8] != b"ftyp" or start[8:] not in _HEIC_BRANDS:
        return False
    try:
        import pillow_heif
    except ImportError:
        raise InputError(
            f'{path}: is a HEIC picture; pip install "extrap-train[heic]" to read it, or convert '
            "it to JPEG"
        ) from None
    pillow_heif.register_heif_opener()
    return True


def _orientation(picture: Image.Image) -> int:
    """1 (upright) to 8, as EXIF counts them; 1 where the file says nothing or nonsense."""
    try:
        # Not a PNG's own method, which would decode the picture.
        tag = Image.Image.getexif(picture).get(_ORIENTATION_TAG)
    except DECODER_ERRORS:
        return 1
    return tag if tag in _TURN_BACK else 1


def _sizes(picture: Image.Image, tag: int) -> tuple[tuple[int, int], tuple[int, int]]:
    """(height, width) as stored and as the orientation turns it."""
    size = picture.height, picture.width
    if tag not in _QUARTER_TURNS:
        return size, size
    turned = size[::-1]
    return (turned, size) if picture.format == "TIFF" else (size, turned)


def _text(size: tuple[int, int]) -> str:
    return f"{size[0]} x {size[1]}"


def _on_ground(picture: Image.Image, grey: int) -> Image.Image:
    """The picture over grey where it is transparent."""
    ground = Image.new("RGBA", picture.size, (grey, grey, grey, 255))
    return Image.alpha_composite(ground, picture.convert("RGBA"))


@functools.lru_cache(maxsize=1024)
def _warn_of_full_masks(folder: Path) -> None:
    log.warning(
        "%s: holds masks that select the whole picture; correct or remove them",
        folder,
    )


@functools.lru_cache(maxsize=1024)
def _warn_of_orientation(folder: Path) -> None:
    log.warning(
        "%s: holds pictures whose EXIF orientation says that they were taken turned, and the size "
        "of their cameras fits both ways: they are taken as they are stored; turn the files "
        "themselves if their cameras show them upright",
        folder,
    )
