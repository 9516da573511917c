"""Depth maps that another program has written, one file per photograph; see docs/depth_files.md."""

import tokenize
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import IO

import numpy as np
import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from extrap_train.data.image_files import (
    MAX_PIXELS,
    NO_DEPTH_16_BIT,
    image_size,
    read_picture,
)
from extrap_train.data.paths import require_file
from extrap_train.errors import InputError
from extrap_train.views import Camera

SUFFIXES = (".npz", ".npy", ".png")
MAX_ASPECT_CHANGE = 0.06
"""Networks round both sides to multiples of their patch."""
MAX_FOCAL_CHANGE = 0.02
MAX_SHIFT = 0.02
"""Of the principal point, as a share of the side."""
MAX_TURN_DEG = 1.0
MAX_STEP = 0.01
"""Between the two positions of a camera, as a share of the cameras' extent."""
_MAX_HEADER = 4096
_DAMAGE = (
    *(OSError, EOFError, ValueError, TypeError, SyntaxError, ArithmeticError, RecursionError),
    *(MemoryError, NotImplementedError, RuntimeError, tokenize.TokenError),
    *(zipfile.BadZipFile, zlib.error),
)
"""What zipfile and NumPy raise on damaged files."""


@dataclass(frozen=True)
class StoredDepth:
    """One file: a map of the whole undistorted photograph at any size, in any unit."""

    file: Path
    depth: Float[Tensor, "h w"]
    """As it is stored, but 0 where it is unknown."""
    confidence: Float[Tensor, "h w"]
    """0 to 1; 0 where depth is unknown, and 1 elsewhere if the file has none."""
    intrinsics: Float[Tensor, "3 3"] | None = None
    """At the size of the map."""
    world_to_cam: Float[Tensor, "4 4"] | None = None


def find_depth_file(folder: Path, photograph: str) -> Path | None:
    """The depth file of a photograph, named by its path below the capture's root: that path with a
    suffix replaced or added; None if none is there.

    InputError if there is more than one.
    """
    path = folder / PurePosixPath(photograph)
    names = [path.with_suffix(suffix) for suffix in SUFFIXES]
    names += [path.with_name(path.name + suffix) for suffix in SUFFIXES]
    found = [name for name in dict.fromkeys(names) if name.is_file()]
    if len(found) > 1:
        raise InputError(
            f"{found[0]}: {found[1].name} beside it is called like depth, too; move one of them"
        )
    return found[0] if found else None


def read_depth_file(file: Path) -> StoredDepth:
    """Read an NPZ, NPY or greyscale PNG file; InputError if it is damaged, too large or empty."""
    arrays = {"depth": _read_png(file)} if file.suffix == ".png" else _read_arrays(file)
    if "depth" not in arrays:
        raise InputError(f"{file}: has no array `depth`; write one")
    is_known = np.isfinite(arrays["depth"])
    arrays = {name: np.where(np.isfinite(values), values, 0) for name, values in arrays.items()}
    depth = arrays["depth"]
    confidence = arrays.get("confidence", np.ones(depth.shape, np.float32))
    shapes = {"confidence": depth.shape, "intrinsics": (3, 3), "world_to_cam": (4, 4)}
    for name, shape in shapes.items():
        if name in arrays and arrays[name].shape != shape:
            raise InputError(f"{file}: `{name}` is {arrays[name].shape}, not {shape}; correct it")
    if depth.ndim != 2 or not depth.any():
        raise InputError(
            f"{file}: `depth` of shape {depth.shape} is zero everywhere or no map of height x "
            "width; restore or remove the file"
        )
    if not 0 <= confidence.min() <= confidence.max() <= 1:
        raise InputError(
            f"{file}: `confidence` is {confidence.min():.3g} to {confidence.max():.3g}, and must "
            "be 0 to 1; rescale it or leave it out"
        )
    # Inverse depth may be 0 where it is known, so that 0 alone does not say unknown.
    confidence = confidence * is_known
    camera = {name: _matrix(arrays[name], name, file) for name in [*shapes][1:] if name in arrays}
    return StoredDepth(file, torch.from_numpy(depth), torch.from_numpy(confidence), **camera)


def require_same_camera(stored: StoredDepth, camera: Camera, extent: float) -> None:
    """InputError if the file's shape, intrinsics or pose are not those of the photograph's camera.

    `extent` is the cameras' extent in the capture's world.
    """
    height, width = stored.depth.shape
    across, down = width / camera.width, height / camera.height
    if not abs(across / down - 1) <= MAX_ASPECT_CHANGE:
        raise InputError(
            f"{stored.file}: has {height} x {width} values (height x width), but the photograph "
            f"is of {camera.height} x {camera.width} pixels; a file must cover the whole of it"
        )
    if stored.intrinsics is not None:
        scaled = camera.resized(height, width).intrinsics.double()
        ours, theirs = scaled.cpu(), stored.intrinsics
        focal = (theirs.diagonal()[:2] / ours.diagonal()[:2] - 1).abs().max()
        shift = ((theirs - ours)[:2, 2] / torch.tensor([width, height])).abs().max()
        if not (focal <= MAX_FOCAL_CHANGE and shift <= MAX_SHIFT):
            raise InputError(
                f"{stored.file}: its focal length and principal point {_lens(theirs)} are not the "
                f"scene's {_lens(ours)} at {height} x {width}; use the scene's own intrinsics"
            )
    if stored.world_to_cam is not None:
        ours, theirs = camera.world_to_cam.double().cpu(), stored.world_to_cam
        cosine = ((ours[:3, :3] @ theirs[:3, :3].mT).trace() - 1) / 2
        turn_deg = float(cosine.clamp(-1, 1).arccos().rad2deg())
        step = float((_center(ours) - _center(theirs)).norm()) / max(extent, 1e-12)
        if not (turn_deg <= MAX_TURN_DEG and step <= MAX_STEP):
            raise InputError(
                f"{stored.file}: its world_to_cam is turned by {turn_deg:.1f}° and moved by "
                f"{step:.0%} of the cameras' extent against the scene's; store the scene's own "
                "pose or none"
            )


def _center(world_to_cam: Float[Tensor, "4 4"]) -> Float[Tensor, "3"]:
    return -world_to_cam[:3, :3].mT @ world_to_cam[:3, 3]


def _lens(intrinsics: Float[Tensor, "3 3"]) -> str:
    k = intrinsics
    return f"({k[0, 0]:.0f}, {k[1, 1]:.0f}, {k[0, 2]:.0f}, {k[1, 2]:.0f})"


def _matrix(values: Shaped[np.ndarray, "n n"], name: str, file: Path) -> Float[Tensor, "n n"]:
    if not np.linalg.det(values):
        raise InputError(f"{file}: `{name}` is no matrix of a camera; correct or leave it out")
    return torch.from_numpy(values).double()


def _read_png(file: Path) -> Float[np.ndarray, "h w"]:
    """NaN where sensors write that they measured nothing."""
    size = image_size(file)
    picture = read_picture(file, size, ("I;16", "I;16B", "I"), resize=False)
    values = np.asarray(picture).astype(np.float32)
    return np.where(values == NO_DEPTH_16_BIT, np.float32(np.nan), values)


def _read_arrays(file: Path) -> dict[str, Float[np.ndarray, "..."]]:
    """The arrays that are known, by their name; that of an NPY file is the depth."""
    require_file(file)
    try:
        with file.open("rb") as stream:
            if file.suffix == ".npy":
                return {"depth": _read_array(stream)}
            arrays = {}
            with zipfile.ZipFile(stream) as archive:
                for name in {"depth", "confidence", "intrinsics", "world_to_cam"}:
                    if f"{name}.npy" in archive.NameToInfo:
                        with archive.open(f"{name}.npy") as part:
                            arrays[name] = _read_array(part)
            return arrays
    except _DAMAGE as error:
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"{file}: is truncated, damaged or too large ({reason})") from None


def _read_array(stream: IO[bytes]) -> Float[np.ndarray, "..."]:
    """Numbers of an NPY stream in single precision; ValueError unless the header is plausible.

    They need not be finite. No more is read than the header says, and never more than
    `MAX_PIXELS` numbers.
    """
    read_header = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }[np.lib.format.read_magic(stream)]
    shape, is_fortran, dtype = read_header(stream, max_header_size=_MAX_HEADER)
    count = int(np.prod(shape, dtype=object))
    if dtype.kind not in "fiu" or not 0 < count <= MAX_PIXELS:
        raise ValueError(f"it holds {dtype} of shape {shape}")
    content = stream.read(count * dtype.itemsize)
    if len(content) != count * dtype.itemsize:
        raise ValueError(f"{len(content)} bytes instead of {count * dtype.itemsize}")
    values = np.frombuffer(content, dtype).reshape(shape, order="F" if is_fortran else "C")
    with np.errstate(invalid="ignore", over="ignore"):
        return np.ascontiguousarray(np.squeeze(values).astype(np.float32))
