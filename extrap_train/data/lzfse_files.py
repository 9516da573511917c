"""Record3D's depth and confidence: bare numbers compressed with LZFSE, in a picture's shape."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Shaped

from extrap_train.data.image_files import same_view
from extrap_train.data.paths import require_file
from extrap_train.errors import InputError

DEPTH_SUFFIX, CONFIDENCE_SUFFIX = ".depth", ".conf"
_MAX_BYTES = 4 * 960 * 720
"""The largest map that the app writes, in single precision."""
_MAX_BLOCKS = _MAX_BYTES // 40_000 + 2
"""A full block has at least as many bytes. No block unpacks to more than 24 MB, so a hostile file
takes less than 2 GB."""
_HEADER_BYTES = 12
_BLOCK = b"bvx"


def read_lzfse_array(
    path: Path, size: tuple[int, int], kinds: Sequence[str]
) -> Shaped[np.ndarray, "h w"]:
    """Numbers of one of NumPy's `kinds`, the first that fills the shape of `size` (height, width).

    Raises InputError where none does, where the file is damaged, or without the extra `record3d`.
    """
    content = _decompress(path)
    for kind in kinds:
        count, rest = divmod(len(content), np.dtype(kind).itemsize)
        height = max(round(math.sqrt(count * size[0] / size[1])), 1)
        shape = height, count // height
        if not rest and math.prod(shape) == count and same_view(shape, size):
            return np.frombuffer(content, kind).reshape(shape)
    raise InputError(
        f"{path}: its {len(content)} bytes are no map of the shape {size[0]} x {size[1]} (height x "
        "width); export the capture again"
    )


def _decompress(path: Path) -> bytes:
    try:
        import lzfse
    except ImportError:
        raise InputError(
            f'{path}: is compressed with LZFSE; pip install "extrap-train[record3d]" to read it'
        ) from None
    if require_file(path).stat().st_size > 2 * _MAX_BYTES:
        raise InputError(f"{path}: is too large for a map of depth; export the capture again")
    content = path.read_bytes()
    # The library believes what the first block says of its size, and reads beyond a short file.
    is_sane = (
        len(content) >= _HEADER_BYTES
        and content.startswith(_BLOCK)
        and int.from_bytes(content[4:8], "little") <= _MAX_BYTES
        and content.count(_BLOCK) <= _MAX_BLOCKS
    )
    try:
        return bytes(lzfse.decompress(content)) if is_sane else b""
    except (lzfse.error, MemoryError):
        return b""
