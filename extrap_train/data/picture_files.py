"""Picture files from outside: few formats, nothing decoded before its size is known, and turned
the way their cameras hold them.
"""

import functools
import logging
import math
import struct
import warnings
from collections.abc import Callable
from pathlib import Path

from PIL import Image, ImageOps

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
_MOST_ROUNDING = 0.05
"""Two shapes that differ by more are never taken for one, however few pixels they have."""
_HEIC_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1")

log = logging.getLogger(__name__)
# Of damaged EXIF, or sizes below the limit here: what matters is said in one line by this module.
warnings.filterwarnings("ignore", module=r"PIL\.")


def open_picture(path: Path) -> Image.Image:
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
    if not is_readable_size(picture):
        raise InputError(
            f"{path}: has {picture.height} x {picture.width} pixels, and only 1 to {MAX_PIXELS:,}, "
            f"at most {MAX_SIDE:,} a side, can be read; resize the picture or remove its entry"
        )
    return picture


def is_readable_size(picture: Image.Image) -> bool:
    """Whether a picture's header says nothing that would cost too much memory to decode."""
    width, height = picture.size
    return max(width, height) <= MAX_SIDE and 0 < width * height <= MAX_PIXELS


def image_size(path: Path, annotated: tuple[int, int] | None = None) -> tuple[int, int]:
    """(height, width) in pixels, from the file's header alone.

    It is that of the turned picture where an EXIF orientation makes a quarter turn of it and
    `annotated`, the size of its camera, has the turned picture's shape. InputError where such a
    picture has no annotated size: nothing then says which way its camera holds it.
    """
    with open_picture(path) as picture:
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


def same_view(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether two sizes have one shape, up to a pixel of rounding in the smaller of them."""
    (height, width), (large_height, large_width) = sorted((size, other))
    scales = height / large_height, width / large_width
    rounding = min(1 / large_height + 1 / large_width, _MOST_ROUNDING * max(scales))
    return scales[1] <= 1 and abs(scales[0] - scales[1]) <= rounding


def upright_photograph(path: Path) -> tuple[tuple[int, int], float | None]:
    """(height, width) once turned by the EXIF orientation, and the focal length that EXIF tells.

    The latter in pixels, from the one that has the same angle of view on 35 mm film.
    """
    with open_picture(path) as picture:
        _, size = _sizes(picture, _orientation(picture))
        try:
            exif = Image.Image.getexif(picture).get_ifd(_EXIF_TAG)
            focal_mm = float(exif.get(_FOCAL_LENGTH_35MM_TAG, 0))
        except DECODER_ERRORS:
            focal_mm = 0.0
    if not 0 < focal_mm < math.inf:
        return size, None
    return size, focal_mm / math.hypot(24, 36) * math.hypot(*size)


def read_turned(
    path: Path,
    size: tuple[int, int],
    fits: Callable[[tuple[int, int], tuple[int, int]], bool],
    upright: bool = False,
) -> Image.Image:
    """The decoded picture, turned by its EXIF orientation where only then its size fits `size`.

    Raises InputError where neither does. Where both do, it is turned if `upright`, else taken as it
    is stored, with one warning for each folder.
    """
    with open_picture(path) as picture:
        tag = _orientation(picture)
        # Before decoding: a header that lies about its size must not cost memory.
        stored, turned = _sizes(picture, tag)
        as_turned = fits(turned, size)
        as_stored = fits(stored, size) and not (upright and as_turned)
        if not (as_stored or as_turned):
            turns = f", turned by its EXIF orientation {_text(turned)}," if turned != stored else ""
            raise InputError(
                f"{path}: is {_text(stored)} pixels (height x width){turns} but its annotation "
                f"says {_text(size)}; restore the file or correct the annotation"
            )
        if tag != 1 and as_stored and as_turned:
            _warn_of_orientation(path.parent)
        try:
            picture.load()
            if tag == 1:
                return picture
            # Pillow turns a TIFF by itself.
            straight = picture if picture.format == "TIFF" else ImageOps.exif_transpose(picture)
            return straight.transpose(_TURN_BACK[tag]) if as_stored else straight
        except DECODER_ERRORS:
            raise InputError(
                f"{path}: is truncated or damaged; restore it or remove its entry"
            ) from None


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


@functools.lru_cache(maxsize=1024)
def _warn_of_orientation(folder: Path) -> None:
    log.warning(
        "%s: holds pictures whose EXIF orientation says that they were taken turned, and the size "
        "of their cameras fits both ways: they are taken as they are stored; turn the files "
        "themselves if their cameras show them upright",
        folder,
    )


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
