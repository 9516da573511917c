"""Prepared data on disk, as training reads it: pairs, cameras, and frames, decoded one by one.

<folder>/preparation.json    what it was made from; written last: marks a finished preparation
         sequences.parquet   one row per sequence, dropped ones with their reason
         frames.parquet      one row per frame: name, camera, whether it may serve as a reference
         pairs.parquet       one row per ordered pair (reference → query)
         split.json          test sequences (or frames), with a hash
<frames>/frames/<category>/<sequence>/frames.npy, frames.parquet
         lone_frames/…       of a sequence that is trained and tested on, with frames held out
<pairs>/train_pairs/<category>/<sequence>/flows.npy, pairs.parquet
        test_pairs/…, train_and_test_pairs/…

Frames and pairs lie in folders that other preparations may share; the manifest says which.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from jaxtyping import Bool, Float, Float16, Int, UInt8
from torch import Tensor

from extrap_train.config import PrepConfig, options_of
from extrap_train.data.frame_files import (
    FLOWS,
    FRAMES,
    REMEDY,
    StoredFrames,
    damaged_error,
    frames_folder,
    map_array,
    matrices_of,
    pairs_folder,
    sequence_folder,
    table_digest,
)
from extrap_train.errors import InputError
from extrap_train.store.records import read_record
from extrap_train.views import Camera, ViewPair

FORMAT = 6
Fetch = Callable[[Path], None]
"""Lets a file be where it is wanted, or raises InputError."""
_MAX_SIZE = options_of(PrepConfig)["image_size"].declared.high
UNTOUCHED = -1
"""Flow number of a pair without a flow: its warp stays as it is."""
_REPEATED = ("sequence", "split", "uncorrected")
"""Columns whose words come again row after row: kept as codes, as a million pairs have two million
such words, which would take a quarter of a gigabyte.
"""
TABLES = ("sequences", "frames", "pairs")
_OPEN_SEQUENCES = 128
"""Sequences whose files stay mapped."""


@dataclass(frozen=True)
class _SequenceCounts:
    kept: int
    dropped: int
    failed: int


@dataclass(frozen=True)
class _Manifest:
    """`preparation.json`, as `data_prep.tables` writes it."""

    format: int
    key: str
    files: str
    data: dict[str, Any] | None
    depth: str
    options: dict[str, Any]
    correction: str | None
    frames: str
    pair_files: str
    split: str
    sequences: _SequenceCounts
    pairs: dict[str, int]
    tables: dict[str, str]
    """SHA-256 of each table's file."""
    versions: dict[str, str | None]


@dataclass(frozen=True)
class Pairs:
    """The pairs of one split as columns; an item or an iteration gives `ViewPair`s."""

    sequence: np.ndarray
    query: Int[np.ndarray, " m"]
    reference: Int[np.ndarray, " m"]
    angle_rad: Float[np.ndarray, " m"]
    score: Float[np.ndarray, " m"]
    flow: Int[np.ndarray, " m"]
    """Number of the pair's flow in its sequence; `UNTOUCHED` of none."""
    error_before: Float[np.ndarray, " m"]
    """Photometric error of the warp against the truth; NaN where nothing was compared."""
    error_after: Float[np.ndarray, " m"]
    uncorrected: np.ndarray
    """Why a compared warp stays as it is; else empty."""

    def __len__(self) -> int:
        return len(self.query)

    def __getitem__(self, index: int) -> ViewPair:
        references = (int(self.reference[index]),)
        score = float(self.score[index])
        return ViewPair(str(self.sequence[index]), int(self.query[index]), references, score)

    def __iter__(self) -> Iterator[ViewPair]:
        return (self[index] for index in range(len(self)))


class PreparedData:
    """One prepared folder. Sequences are named `category/name`; safe to use across processes."""

    def __init__(
        self,
        folder: Path,
        manifest: dict[str, Any],
        sequences: pd.DataFrame,
        frames: pa.Table,
        pairs: pd.DataFrame,
        fetch: Fetch | None = None,
    ) -> None:
        self.folder = folder
        self._fetch = fetch
        self.manifest = manifest
        self.sequences = sequences
        """One row per sequence: name, verdict with reason, measurements, split, number of pairs."""
        self.image_size: int = manifest["options"]["image_size"]
        self._pairs = pairs
        self._world_to_cam = matrices_of(frames, "world_to_cam", (4, 4))
        self._intrinsics = matrices_of(frames, "intrinsics", (3, 3))
        self._frames = frames
        self._depth_scale = frames["depth_scale"].to_numpy()
        self._reference = frames["reference"].to_numpy()
        self._names = frames["name"]
        self._rows = _row_ranges(frames["sequence"].to_numpy())
        kept = sequences[sequences["kept"]]
        self.roles: dict[str, str] = dict(zip(kept["sequence"], kept["split"], strict=True))
        """`train`, `test` or `train and test` of every sequence that is kept."""
        self._frames_root = folder / manifest["frames"]
        self._pairs_root = folder / manifest["pair_files"]
        self._pair_rows = _row_ranges(_values(pairs["sequence"]))
        self._flow_numbers: Callable[[str], np.ndarray] = lru_cache(_OPEN_SEQUENCES)(
            self._read_flow_numbers
        )
        self._flows: Callable[[str], np.ndarray] = lru_cache(_OPEN_SEQUENCES)(self._open_flows)
        self._archive: Callable[[str], StoredFrames] = lru_cache(_OPEN_SEQUENCES)(
            self._open_archive
        )

    @classmethod
    def open(cls, folder: Path, fetch: Fetch | None = None) -> "PreparedData":
        """Open a finished preparation; raises InputError where it is missing or damaged.

        Frames and flows that are not there yet are put there by `fetch`.
        """
        manifest = read_preparation(folder)
        tables = {name: _read_table(folder, name, manifest) for name in TABLES}
        try:
            return cls(
                folder,
                manifest,
                tables["sequences"].to_pandas(),
                tables["frames"],
                tables["pairs"].to_pandas(),
                fetch,
            )
        except (KeyError, ValueError, TypeError, IndexError) as error:
            raise damaged_error(folder, f"a column is missing or odd: {error}") from None

    def pairs(self, split: str) -> Pairs:
        """The pairs of `train` or `test`, sequence by sequence, best score first."""
        if split not in ("train", "test"):
            raise ValueError(f"split is train or test, not {split!r}")
        rows = self._pairs[self._pairs["split"] == split]
        return Pairs(*(_values(rows[field.name]) for field in fields(Pairs)))

    def cameras(self, sequence: str) -> Camera:
        """All cameras of a sequence, at the store's image size."""
        rows = self._rows[sequence]
        size = self.image_size
        return Camera(self._world_to_cam[rows], self._intrinsics[rows], size, size)

    def names(self, sequence: str) -> list[str]:
        """The frames' names, in their order."""
        return self._names[self._rows[sequence]].to_pylist()

    def reference_frames(self, sequence: str) -> Int[np.ndarray, " m"]:
        """The frames that may serve as references: not held out, and with some depth known."""
        return np.flatnonzero(self._reference[self._rows[sequence]])

    def images(self, sequence: str, indices: Sequence[int]) -> UInt8[Tensor, "k 3 h w"]:
        """The colours of some frames, as bytes."""
        return self._archive(sequence).images(indices)

    def depths(self, sequence: str, indices: Sequence[int]) -> Float16[Tensor, "k h w"]:
        """Depth of some frames in units of `depth_unit`; 0 is unknown."""
        return self._archive(sequence).depths(indices)

    def mask(self, sequence: str, index: int) -> Bool[Tensor, "h w"]:
        """Where a frame shows the object; everywhere where the capture has no mask."""
        return self._archive(sequence).mask(index)

    def image_checksums(self, sequence: str) -> list[int]:
        """CRC-32 of every frame's photograph as it is stored."""
        rows = self._rows[sequence]
        return self._frames["image_crc32"].slice(rows.start, rows.stop - rows.start).to_pylist()

    def beside_frames(self, kind: str, sequence: str) -> Path:
        """Where files of another kind about a sequence's frames lie, for all who share these."""
        is_lone = self.roles[sequence] == "train and test"
        return sequence_folder(self._frames_root, f"lone_{kind}" if is_lone else kind, sequence)

    def depth_unit(self, sequence: str) -> float:
        """A sequence's unit of depth in scene units, a power of two."""
        return float(self._depth_scale[self._rows[sequence].start])

    @property
    def is_corrected(self) -> bool:
        """Whether the training pairs have been compared with the truth."""
        return bool(self.manifest["correction"])

    def partners(self, sequence: str, query: int) -> Int[np.ndarray, " m"]:
        """The frames that make a training pair with this query, so that their flow is known."""
        return np.flatnonzero(self._flow_numbers(sequence)[:, query] >= UNTOUCHED)

    def queries(self, sequence: str, reference: int) -> Int[np.ndarray, " m"]:
        """The frames that make a training pair with this reference."""
        return np.flatnonzero(self._flow_numbers(sequence)[reference] >= UNTOUCHED)

    def flows(
        self, sequence: str, references: Sequence[int], query: int
    ) -> Float[Tensor, "k 2 g g"]:
        """Where the warp of each reference really belongs in the query (`geometry.spline_flow`);
        zero where it stays as it is."""
        numbers = self._flow_numbers(sequence)[list(references), query]
        stored = self._flows(sequence)
        chosen = np.zeros((len(numbers), *stored.shape[1:]), np.float32)
        chosen[numbers >= 0] = stored[numbers[numbers >= 0]]
        return torch.from_numpy(chosen)

    def _read_flow_numbers(self, sequence: str) -> Int[np.ndarray, "n n"]:
        """By reference and query; pairs that are not for training have less than `UNTOUCHED`."""
        frames = self._rows[sequence]
        numbers = np.full(2 * (frames.stop - frames.start,), UNTOUCHED - 1, np.int32)
        rows = self._pairs.iloc[self._pair_rows.get(sequence, slice(0, 0))]
        rows = rows[rows["split"] == "train"]
        numbers[rows["reference"], rows["query"]] = rows["flow"]
        return numbers

    def _open_flows(self, sequence: str) -> np.ndarray:
        folder = self._pairs_folder(sequence)
        grid = self.manifest["options"].get("correction_grid")
        flows = map_array(self._here(folder / FLOWS))
        if flows.shape[1:] != (2, grid, grid) or flows.dtype != np.float16:
            raise damaged_error(folder, f"flows are {flows.shape}")
        return flows

    def _open_archive(self, sequence: str) -> StoredFrames:
        folder, rows = self._frames_folder(sequence), self._rows[sequence]
        self._here(folder / FRAMES)
        table = self._frames.slice(rows.start, rows.stop - rows.start)
        return StoredFrames(folder, table, self.image_size)

    def files(self, sequence: str) -> list[tuple[Path, Path]]:
        """The files that a sequence's frames and flows are read from, each after its root."""
        found = [(self._frames_root, self._frames_folder(sequence) / FRAMES)]
        if self.is_corrected:
            found.append((self._pairs_root, self._pairs_folder(sequence) / FLOWS))
        return found

    def _frames_folder(self, sequence: str) -> Path:
        is_lone = self.roles[sequence] == "train and test"
        return frames_folder(self._frames_root, sequence, is_lone)

    def _pairs_folder(self, sequence: str) -> Path:
        return pairs_folder(self._pairs_root, sequence, self.roles[sequence])

    def _here(self, file: Path) -> Path:
        if self._fetch is not None:
            self._fetch(file)
        return file

    def __reduce__(
        self,
    ) -> tuple[Callable[[Path, Fetch | None], "PreparedData"], tuple[Path, Fetch | None]]:
        """In another process the folder is opened anew: a pickled memory map would be a copy."""
        return PreparedData.open, (self.folder, self._fetch)


def read_preparation(folder: Path) -> dict[str, Any]:
    """What a folder was prepared from; raises InputError where that is missing or damaged."""
    file = folder / "preparation.json"
    if not file.is_file():
        raise InputError(f"{folder}: holds no finished preparation; run data_prep again")
    manifest = read_record(file, _Manifest, REMEDY)
    size = manifest.options.get("image_size")
    if manifest.format != FORMAT or type(size) is not int or not 1 <= size <= _MAX_SIZE:
        raise damaged_error(folder, f"{file} is not a manifest of format {FORMAT}")
    return asdict(manifest)


def _read_table(folder: Path, name: str, manifest: dict[str, Any]) -> pa.Table:
    """A table as it was written: what is damaged is never parsed."""
    file = folder / f"{name}.parquet"
    if table_digest(file) != manifest["tables"].get(name):
        raise damaged_error(folder, f"{file} is missing or was changed")
    try:
        words = [name for name in _REPEATED if name in pq.read_schema(file).names]
        return pq.read_table(file, read_dictionary=words).combine_chunks()
    except (OSError, pa.ArrowException) as error:
        reason = str(error).splitlines()[0]
        raise damaged_error(folder, f"{file}: {reason}") from None


def _values(column: pd.Series) -> np.ndarray:
    """A column's values, equal words being one object."""
    if isinstance(column.dtype, pd.CategoricalDtype):
        words = column.cat.categories.to_numpy(dtype=object)
        found: np.ndarray = words[column.cat.codes]
        return found
    return column.to_numpy()


def _row_ranges(sequences: np.ndarray) -> dict[str, slice]:
    """Where each sequence's rows lie; a sequence's rows are together."""
    starts = np.flatnonzero(np.r_[True, sequences[1:] != sequences[:-1]])
    stops = [*starts[1:], len(sequences)]
    return {str(sequences[a]): slice(int(a), int(b)) for a, b in zip(starts, stops, strict=True)}
