"""Depth maps on disk to depth in scene units: CO3D's half floats, 16-bit pictures, TIFF, NPY, and
Record3D's files."""

import tokenize
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Shaped, UInt8
from torch import Tensor

from extrap_train.data.image_files import (
    MAX_PIXELS,
    NO_DEPTH_16_BIT,
    nearest_pixels,
    read_grey,
    read_picture,
    same_view,
)
from extrap_train.data.lzfse_files import CONFIDENCE_SUFFIX, DEPTH_SUFFIX, read_lzfse_array
from extrap_train.data.paths import require_file
from extrap_train.errors import InputError

ARRAY_ERRORS = (
    *(OSError, EOFError, ValueError, TypeError, SyntaxError, ArithmeticError),
    *(RecursionError, MemoryError, tokenize.TokenError),
)
"""What NumPy raises on damaged NPY files."""
MAX_DEPTH_SCALE = 1e6
"""Scene units per unit of a depth file; a larger one is damage."""

_SIXTEEN_BIT_MODES = ("I;16", "I;16B")
_DEPTH_MODES = (*_SIXTEEN_BIT_MODES, "I", "F")


@dataclass(frozen=True, slots=True)
class DepthFile:
    """A depth map on disk; paths are relative to the data set's root."""

    path: str
    scale: float
    """Scene units per unit of the file."""
    mask_path: str | None = None
    """Path of a picture that shows which of the depths to trust."""
    is_half_float: bool = False
    """Whether the 16 bits of its pixels are CO3D's float16, no whole numbers."""

    def read(self, root: Path, size: tuple[int, int]) -> Float[Tensor, "h w"]:
        """The depth in scene units at `size` (height, width); 0 where unknown or not trusted.

        Reads a greyscale picture of 16 bits (its largest value means unknown), a TIFF of 32 bits,
        an NPY array, or a file of Record3D's. The map must have the aspect ratio of `size` and is
        resampled from the nearest pixels. An empty map and an impossible scale are errors.
        """
        path = root / self.path
        if self.is_half_float:
            raw = np.asarray(read_picture(path, size, _SIXTEEN_BIT_MODES))
            raw = raw.astype(np.uint16).view(np.float16)
        elif path.suffix.lower() == ".npy":
            raw = _read_npy(path, size)
        elif path.suffix == DEPTH_SUFFIX:
            raw = read_lzfse_array(path, size, ("<f4", "<f2"))
        else:
            raw = np.asarray(read_picture(path, size, _DEPTH_MODES))
        depth = self._in_scene_units(nearest_pixels(raw, size), path)
        if self.mask_path:
            depth *= torch.from_numpy(_read_trust(root / self.mask_path, size) > 0)
        return depth

    def _in_scene_units(self, raw: Shaped[np.ndarray, "h w"], path: Path) -> Float[Tensor, "h w"]:
        if not 0 < self.scale < MAX_DEPTH_SCALE:
            raise InputError(
                f"{path}: the scale of its depth is {self.scale}, no possible one; correct its "
                "entry or estimate depth (depth=stereo)"
            )
        with np.errstate(invalid="ignore", over="ignore"):
            depth = raw.astype(np.float32) * np.float32(self.scale)
        depth[~(np.isfinite(depth) & (depth > 0))] = 0
        if raw.dtype.kind == "u" and raw.dtype.itemsize == 2:
            depth[raw == NO_DEPTH_16_BIT] = 0
        if not depth.any():
            raise InputError(
                f"{path}: the depth map is zero everywhere; remove it or its frame, or estimate "
                "depth (depth=stereo)"
            )
        return torch.from_numpy(depth)


def find_depth(root: Path, depth: str, scale: float, confidence: str) -> DepthFile | None:
    """A frame's depth by its path below the root, trusted where `confidence` is not 0 if that file
    is there; None where there is no depth.
    """
    if not (root / depth).exists():
        return None
    return DepthFile(depth, scale, confidence if (root / confidence).exists() else None)


def _read_trust(path: Path, size: tuple[int, int]) -> UInt8[np.ndarray, "h w"]:
    if path.suffix == CONFIDENCE_SUFFIX:
        return nearest_pixels(read_lzfse_array(path, size, ("u1",)), size)
    return read_grey(path, size)


def _read_npy(path: Path, size: tuple[int, int]) -> Shaped[np.ndarray, "h w"]:
    require_file(path)
    try:
        # Mapped, not read: the header may promise any size.
        raw: np.ndarray = np.lib.format.open_memmap(path, mode="r")
    except ARRAY_ERRORS as error:
        raise InputError(f"{path}: is not an array of numbers ({error}); restore it") from None
    if raw.ndim == 3 and raw.shape[2] == 1:
        raw = raw[..., 0]
    fits = raw.ndim == 2 and 0 < raw.size <= MAX_PIXELS and same_view(raw.shape, size)
    if not fits or raw.dtype.kind not in "fiu":
        raise InputError(
            f"{path}: is an array of {raw.dtype} {raw.shape}, expected numbers {size}; restore it"
        )
    return np.asarray(raw)
