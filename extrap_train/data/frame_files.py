"""The folder of one prepared sequence: what is in it, and how it gets there whole or not at all."""

import json
import math
import re
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from jaxtyping import Float, Float16, Shaped, UInt8
from pydantic import TypeAdapter, ValidationError
from torch import Tensor

from extrap_train.data.frame_codec import decode_depth, decode_image, encode_depth, encode_image
from extrap_train.data.paths import file_stamp
from extrap_train.errors import InputError
from extrap_train.store.atomic import atomic_folder, save_array
from extrap_train.views import Camera, View

FLOWS = "flows.npy"
"""Of the pairs of one sequence, beside their table: control vectors (`geometry.spline_flow`)."""
FRAMES, CAMERAS = "frames.npy", "frames.parquet"
"""A sequence's encoded frames (`frame_codec`), one after the other, and their table."""
REMEDY = "run data_prep again, which makes what is damaged once more"
_PARTS = ("image", "depth")
_KEY, _SIZES, _DIGEST = b"key", b"sizes", b"sha256"
_SAFE_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]{0,99}")


@dataclass(frozen=True)
class SequenceFrames:
    """All frames of one sequence at the store's size."""

    names: tuple[str, ...]
    camera: Camera
    images: UInt8[np.ndarray, "n h w 3"]
    depths: Float[np.ndarray, "n h w"]
    masks: UInt8[np.ndarray, "n h w"]
    """255 is the object; 255 everywhere where the capture has no mask. Not stored: they have placed
    the square, and training reads none."""


class FrameArchive:
    """The frames of one sequence on disk, each decoded when it is asked for.

    InputError where the file is not as long as the table says, or a frame is not what was written.
    """

    def __init__(self, folder: Path, table: pa.Table, side: int) -> None:
        self._file, self._side = folder / FRAMES, side
        sizes = np.stack([table[f"{part}_bytes"].to_numpy() for part in _PARTS], 1)
        self._ends = sizes.astype(np.int64).cumsum().reshape(sizes.shape)
        self._starts = self._ends - sizes
        self._checksums = np.stack([table[f"{part}_crc32"].to_numpy() for part in _PARTS], 1)
        self._content = map_array(self._file)
        if self._content.dtype != np.uint8 or self._content.shape != (int(sizes.sum()),):
            raise damaged_error(folder, f"{FRAMES} is not as long as it was")

    def image(self, index: int) -> UInt8[Tensor, "3 h w"]:
        """The photograph's bytes of colour."""
        return torch.from_numpy(self._decoded(index, 0, decode_image))

    def depth(self, index: int) -> Float16[Tensor, "h w"]:
        """The depth map in the sequence's unit; 0 is unknown."""
        return torch.from_numpy(self._decoded(index, 1, decode_depth))

    def _decoded(
        self, index: int, part: int, decode: Callable[[np.ndarray, int], np.ndarray]
    ) -> np.ndarray:
        content = np.asarray(self._content[self._starts[index, part] : self._ends[index, part]])
        try:
            if zlib.crc32(content.data) != self._checksums[index, part]:
                raise ValueError("not what was written")
            return decode(content, self._side)
        except ValueError as error:
            raise InputError(
                f"{self._file} is damaged ({_PARTS[part]} of frame {index}: {error}); delete its "
                "folder and run data_prep again"
            ) from None


@dataclass(frozen=True)
class StoredFrames:
    """A prepared sequence's frames on disk, read one at a time."""

    archive: FrameArchive
    camera: Camera
    depth_share: Float[np.ndarray, " n"]
    """Of each frame's pixels, how many have a depth."""
    depth_scale: float

    @classmethod
    def open(cls, folder: Path, table: pa.Table, side: int) -> "StoredFrames":
        """From the folder's table of cameras; frames have `side` × `side` pixels."""
        camera = Camera(
            matrices_of(table, "world_to_cam", (4, 4)),
            matrices_of(table, "intrinsics", (3, 3)),
            side,
            side,
        )
        scale = float(table["depth_scale"][0].as_py())
        archive = FrameArchive(folder, table, side)
        return cls(archive, camera, table["depth_share"].to_numpy(), scale)

    def view(self, index: int) -> View:
        """A frame with its depth in scene units; 0 is unknown."""
        image = self.archive.image(index).float().div_(255)
        depth = self.archive.depth(index).float().mul_(self.depth_scale)
        return View(image, self.camera[index], depth)


def damaged_error(place: Path, what: str) -> InputError:
    """What to say of prepared data that is not as it was written."""
    return InputError(f"{place} is damaged ({what}); {REMEDY}")


def map_array(file: Path) -> np.ndarray:
    """An array on disk, of which no more is asked for than the file holds."""
    try:
        mapped: np.ndarray = np.load(file, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError, TypeError, OverflowError) as error:
        reason = " ".join(str(error).split())[:200]
        raise damaged_error(file.parent, f"{file.name}: {reason}") from None
    if not isinstance(mapped, np.memmap):  # a zip archive
        raise damaged_error(file.parent, f"{file.name} is no array")
    return mapped


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
    parts = [[encode_image(x) for x in frames.images], [encode_depth(x) for x in depths]]
    table = _camera_table(frames, scale)
    for part, contents in zip(_PARTS, parts, strict=True):
        sizes, sums = [len(x) for x in contents], [zlib.crc32(x) for x in contents]
        table = table.append_column(f"{part}_bytes", pa.array(sizes, pa.int32()))
        table = table.append_column(f"{part}_crc32", pa.array(sums, pa.uint32()))
    content = b"".join(image + depth for image, depth in zip(*parts, strict=True))
    place.write(table, {FRAMES: np.frombuffer(content, np.uint8)})


@dataclass(frozen=True)
class SealedTable:
    """A table that seals the arrays beside it, in a folder that is there whole or not at all.

    It holds `key`, what it was made from, how long each file must be, and its own digest: what the
    disk has made of them is compared with that, not with itself.
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
            table = pq.read_table(self.file)
            seal = table.schema.metadata or {}
            sizes = TypeAdapter(dict[str, int]).validate_json(seal.get(_SIZES, b""), strict=True)
            is_sound = seal.get(_DIGEST) == _digest(table)
        except (OSError, pa.ArrowException, ValidationError, UnicodeDecodeError):
            return None
        stamps = [(file_stamp(self.file.with_name(name)), size) for name, size in sizes.items()]
        is_whole = all(stamp is not None and stamp[0] == size for stamp, size in stamps)
        return table if is_sound and is_whole and seal.get(_KEY) == self.key.encode() else None

    def write(self, table: pa.Table, arrays: Mapping[str, Shaped[np.ndarray, "..."]]) -> None:
        """Write the arrays by their files' names, and the table; what is there whole stays."""
        with atomic_folder(self.file.parent, lambda _: self.is_there()) as made:
            sizes = {name: save_array(made / name, arrays[name]) for name in sorted(arrays)}
            seal = {_KEY: self.key.encode(), _SIZES: json.dumps(sizes).encode()}
            seal[_DIGEST] = _digest(_as_read(table))
            pq.write_table(table.replace_schema_metadata(seal), made / self.file.name)


def _as_read(table: pa.Table) -> pa.Table:
    """The table with the types that it has once it was read from a file."""
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink)
    return pq.read_table(pa.BufferReader(sink.getvalue()))


def _digest(table: pa.Table) -> bytes:
    """SHA-256 of the names, types and values of a table's columns."""
    sink = pa.BufferOutputStream()
    plain = table.replace_schema_metadata(None).combine_chunks()
    with pa.ipc.new_stream(sink, plain.schema) as stream:
        stream.write_table(plain)
    return sha256(sink.getvalue()).hexdigest().encode()


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
    return f"{slug or 'unnamed'}-{sha256(part.encode(errors='surrogatepass')).hexdigest()[:12]}"
