"""The folder of one prepared sequence: what is in it, and how it gets there whole or not at all."""

import hashlib
import json
import math
import re
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from jaxtyping import Bool, Float, Float16, Shaped, UInt8
from torch import Tensor

from extrap_train.data.frame_codec import (
    decode_depth,
    decode_image,
    decode_mask,
    encode_depth,
    encode_image,
    encode_mask,
)
from extrap_train.data.paths import file_stamp
from extrap_train.errors import InputError
from extrap_train.store.atomic import atomic_folder, save_array
from extrap_train.store.records import read_record
from extrap_train.views import Camera, View

FLOWS = "flows.npy"
"""File beside the table of a sequence's pairs, with their control vectors
(`geometry.spline_flow`)."""
FRAMES, CAMERAS = "frames.npy", "frames.parquet"
"""A sequence's encoded frames (`frame_codec`), one after the other, and their table."""
REMEDY = "run data_prep again, which makes what is damaged once more"
_PARTS = ("image", "depth", "mask")
_SEAL = ".seal"
_SAFE_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]{0,99}")


@dataclass(frozen=True)
class SequenceFrames:
    """All frames of one sequence at the store's size."""

    names: tuple[str, ...]
    camera: Camera
    images: UInt8[np.ndarray, "n h w 3"]
    depths: Float[np.ndarray, "n h w"]
    masks: UInt8[np.ndarray, "n h w"]
    """255 is the object; 255 everywhere where the capture has no mask."""


class StoredFrames:
    """The frames of one prepared sequence on disk, each decoded when it is asked for.

    From their folder and their table of cameras; they have `side` × `side` pixels. InputError where
    the file is not as long as the table says, or a frame is not what was written.
    """

    def __init__(self, folder: Path, table: pa.Table, side: int) -> None:
        self._file, self._table, self._side = folder / FRAMES, table, side
        sizes = np.stack([table[f"{part}_bytes"].to_numpy() for part in _PARTS], 1)
        self._ends = sizes.astype(np.int64).cumsum().reshape(sizes.shape)
        self._starts = self._ends - sizes
        self._checksums = np.stack([table[f"{part}_crc32"].to_numpy() for part in _PARTS], 1)
        self._content = map_array(self._file)
        if self._content.dtype != np.uint8 or self._content.shape != (int(sizes.sum()),):
            raise damaged_error(folder, f"{FRAMES} is not as long as it was")

    @cached_property
    def camera(self) -> Camera:
        """All cameras."""
        world_to_cam = matrices_of(self._table, "world_to_cam", (4, 4))
        intrinsics = matrices_of(self._table, "intrinsics", (3, 3))
        return Camera(world_to_cam, intrinsics, self._side, self._side)

    @property
    def depth_share(self) -> Float[np.ndarray, " n"]:
        """Share of each frame's pixels that have a depth."""
        return self._table["depth_share"].to_numpy()

    @property
    def depth_scale(self) -> float:
        """The sequence's unit of depth in scene units."""
        return float(self._table["depth_scale"][0].as_py())

    def images(self, indices: Sequence[int]) -> UInt8[Tensor, "k 3 h w"]:
        """The photographs' bytes of colour."""
        return self._decode(indices, 0, decode_image, (3, self._side, self._side), np.uint8)

    def depths(self, indices: Sequence[int]) -> Float16[Tensor, "k h w"]:
        """The depth maps in the sequence's unit; 0 is unknown."""
        return self._decode(indices, 1, decode_depth, (self._side, self._side), np.float16)

    def mask(self, index: int) -> Bool[Tensor, "h w"]:
        """Where the frame shows the object; everywhere where the capture has no mask."""
        return self._decode([index], 2, decode_mask, (self._side, self._side), np.bool_)[0]

    def view(self, index: int) -> View:
        """A frame with its depth in scene units; 0 is unknown."""
        image = self.images([index])[0].float().div_(255)
        depth = self.depths([index])[0].float().mul_(self.depth_scale)
        return View(image, self.camera[index], depth)

    def _decode(
        self,
        indices: Sequence[int],
        part: int,
        decode: Callable[[np.ndarray, np.ndarray], None],
        shape: tuple[int, ...],
        dtype: type[np.generic],
    ) -> Tensor:
        """One part of some frames, each decoded to where it stays."""
        decoded = np.empty((len(indices), *shape), dtype)
        for index, target in zip(indices, decoded, strict=True):
            content = np.asarray(self._content[self._starts[index, part] : self._ends[index, part]])
            try:
                if zlib.crc32(content.data) != self._checksums[index, part]:
                    raise ValueError("not what was written")
                decode(content, target)
            except ValueError as error:
                raise InputError(
                    f"{self._file} is damaged ({_PARTS[part]} of frame {index}: {error}); delete "
                    "its folder and run data_prep again"
                ) from None
        return torch.from_numpy(decoded)


def damaged_error(place: Path, what: str) -> InputError:
    """What to say of prepared data that is not as it was written."""
    return InputError(f"{place} is damaged ({what}); {REMEDY}")


def map_array(file: Path) -> np.ndarray:
    """An array on disk, of which no more is asked for than the file holds.

    It keeps no descriptor, of which a process has a thousand: numpy's map would keep one.
    """
    try:
        mapped: np.ndarray = np.load(file, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError, TypeError, OverflowError) as error:
        reason = " ".join(str(error).split())[:200]
        raise damaged_error(file.parent, f"{file.name}: {reason}") from None
    if not isinstance(mapped, np.memmap):  # a zip archive
        raise damaged_error(file.parent, f"{file.name} is not an array")
    size = mapped.offset + mapped.nbytes
    content = torch.from_file(str(file), size=size, dtype=torch.uint8).numpy()
    content.flags.writeable = False
    return np.ndarray(mapped.shape, mapped.dtype, content, mapped.offset, mapped.strides)


def sequence_folder(root: Path, kind: str, sequence: str) -> Path:
    """Where one kind of files of `category/name` lies; both are untrusted and never lead out of
    `root`."""
    return root.joinpath(kind, *(_safe(part) for part in sequence.split("/", 1)))


def frames_folder(root: Path, sequence: str, lone: bool = False) -> Path:
    """Where the frames of `category/name` lie.

    Those of a `lone` sequence, some of which are held out and have no depth, lie apart.
    """
    return sequence_folder(root, "lone_frames" if lone else "frames", sequence)


def pairs_folder(root: Path, sequence: str, role: str) -> Path:
    """Where the pairs of `category/name` lie; those of each role lie apart."""
    return sequence_folder(root, f"{role} pairs".replace(" ", "_"), sequence)


def matrices_of(table: pa.Table, column: str, shape: tuple[int, int]) -> Float[Tensor, "n r c"]:
    """A column of flattened matrices as a tensor."""
    values = table[column].combine_chunks().flatten().to_numpy()
    return torch.from_numpy(np.array(values, np.float32).reshape(-1, *shape))


def write_frames(place: "SealedTable", frames: SequenceFrames) -> None:
    """Write a sequence's frames, whole or not at all.

    Depth is stored as float16, divided by a power of two near its median: exact for every scene
    unit, relative precision 2⁻¹¹; what is more than 65,504 medians away becomes unknown.
    """
    scale = _depth_scale(frames.depths)
    scaled = frames.depths / scale
    scaled[scaled > np.finfo(np.float16).max] = 0
    depths = scaled.astype(np.float16)
    parts = [
        [encode_image(x) for x in frames.images],
        [encode_depth(x) for x in depths],
        [encode_mask(x >= 128) for x in frames.masks],
    ]
    table = _camera_table(frames, scale)
    for part, contents in zip(_PARTS, parts, strict=True):
        sizes, sums = [len(x) for x in contents], [zlib.crc32(x) for x in contents]
        table = table.append_column(f"{part}_bytes", pa.array(sizes, pa.int32()))
        table = table.append_column(f"{part}_crc32", pa.array(sums, pa.uint32()))
    content = b"".join(b"".join(frame) for frame in zip(*parts, strict=True))
    place.write(table, {FRAMES: np.frombuffer(content, np.uint8)})


@dataclass(frozen=True)
class _Seal:
    """What the files of a folder must be, as JSON beside its table."""

    key: str
    table: str
    """`table_digest` of it."""
    sizes: dict[str, int]
    """In bytes, of the arrays beside it."""


@dataclass(frozen=True)
class SealedTable:
    """A table and the arrays beside it, in a folder that is there whole or not at all.

    `key` says what they were made from.
    """

    file: Path
    key: str

    def is_there(self) -> bool:
        """Whether the table is there, as it was written and made from `key`, and the files beside
        it are as long."""
        return self.read() is not None

    def read(self) -> pa.Table | None:
        """The table, if `is_there`."""
        try:
            seal = read_record(self.file.with_suffix(_SEAL), _Seal, REMEDY)
        except InputError:
            return None
        stamps = [
            (file_stamp(self.file.with_name(name)), size) for name, size in seal.sizes.items()
        ]
        is_whole = all(stamp is not None and stamp[0] == size for stamp, size in stamps)
        if not is_whole or seal.key != self.key or table_digest(self.file) != seal.table:
            return None
        return pq.read_table(self.file)

    def write(self, table: pa.Table, arrays: Mapping[str, Shaped[np.ndarray, "..."]]) -> None:
        """Write the arrays by their files' names, and the table; what is there whole stays."""
        with atomic_folder(self.file.parent, lambda _: self.is_there()) as made:
            sizes = {name: save_array(made / name, arrays[name]) for name in sorted(arrays)}
            file = made / self.file.name
            pq.write_table(table.replace_schema_metadata(None), file)
            seal = _Seal(self.key, table_digest(file), sizes)
            file.with_suffix(_SEAL).write_text(json.dumps(asdict(seal)))


def table_digest(file: Path) -> str:
    """SHA-256 of a table's file; empty if it cannot be read."""
    try:
        with file.open("rb") as content:
            return hashlib.file_digest(content, "sha256").hexdigest()
    except OSError:
        return ""


def _camera_table(frames: SequenceFrames, depth_scale: float) -> pa.Table:
    count = len(frames.names)
    columns = {
        "index": pa.array(range(count), pa.int32()),
        "name": pa.array(frames.names, pa.string()),
        "world_to_cam": _matrices(frames.camera.world_to_cam.numpy(force=True)),
        "intrinsics": _matrices(frames.camera.intrinsics.numpy(force=True)),
        "depth_share": pa.array((frames.depths > 0).mean((1, 2)), pa.float32()),
        "depth_scale": pa.array([depth_scale] * count, pa.float32()),
    }
    return pa.table(columns)


def _matrices(matrices: Float[np.ndarray, "n r c"]) -> pa.Array:
    values = pa.array(matrices.astype(np.float32).reshape(-1))
    return pa.FixedSizeListArray.from_arrays(values, matrices.shape[1] * matrices.shape[2])


def _depth_scale(depths: Float[np.ndarray, "n h w"]) -> float:
    known = depths[depths > 0]
    return 2.0 ** round(math.log2(float(np.median(known)))) if known.size else 1.0


def _safe(part: str) -> str:
    """A file name for an untrusted name: itself where harmless, else a slug with a digest."""
    if _SAFE_NAME.fullmatch(part):
        return part
    slug = re.sub(r"[^A-Za-z0-9_-]+", "_", part)[:40]
    digest = hashlib.sha256(part.encode(errors="surrogatepass")).hexdigest()
    return f"{slug or 'unnamed'}-{digest[:12]}"
