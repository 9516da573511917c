"""The tables of prepared data: sequences with their verdicts, frames, pairs, and the manifest."""

import json
import os
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from data_prep.filter import Verdict
from data_prep.pairs import reference_frames
from data_prep.split import Split
from data_prep.unit import Unit, Workshop
from extrap_train.data.frame_files import read_camera_table
from extrap_train.data.prepared import FORMAT, TABLES, table_digest
from extrap_train.data.sequences import Sequence
from extrap_train.errors import InputError
from extrap_train.store.atomic import partial_path, write_atomic
from extrap_train.store.manifest import package_version

_PACKAGES = ("extrap-train", "numpy", "opencv-python-headless", "pyarrow", "torch")
"""Whose versions may show in what is stored."""
_ROWS_AT_A_TIME = 50_000
"""Rows that are gathered before they are written: memory does not grow with the sequences."""


@dataclass(frozen=True)
class Outcome:
    """What became of a sequence."""

    sequence: Sequence
    verdict: Verdict
    failed: bool
    """Whether it was good enough, but could not be prepared."""
    capture_key: str
    """What its frames are made from (`CaptureKeys.frames_key`)."""

    @property
    def name(self) -> str:
        """`category/name`, as the prepared data calls it."""
        return f"{self.sequence.category}/{self.sequence.name}"


def write_results(
    folder: Path, shop: Workshop, outcomes: list[Outcome], split: Split, facts: Mapping[str, Any]
) -> None:
    """All tables, then the manifest, whose presence says that they are complete.

    It repeats `facts` about what they were made from.
    """
    units = [
        Unit(shop, outcome.sequence, split.role(outcome.name), outcome.capture_key)
        for outcome in outcomes
        if outcome.verdict.kept
    ]
    counts = _write_frames_and_pairs(folder, units)
    parts: Counter[str] = Counter()
    for (_, part), count in counts.pairs.items():
        parts[part] += count
    if not parts["train"]:
        raise InputError(
            f"{folder}: no two frames of the {len(units)} kept sequences make a training pair; "
            "widen prep.min_pair_angle_deg and prep.max_pair_angle_deg, or add photographs"
        )
    rows = pa.Table.from_pandas(_sequence_rows(outcomes, split, counts), preserve_index=False)
    with _writer(folder / "sequences.parquet") as write:
        write(rows)
    write_atomic(folder / "split.json", split.to_json().encode())
    failed = sum(outcome.failed for outcome in outcomes)
    manifest = {
        "format": FORMAT,
        **facts,
        "depth": repr(shop.tools.depth),
        "options": asdict(shop.options),
        "correction": None if shop.tools.correction is None else repr(shop.tools.correction),
        "frames": os.path.relpath(shop.frames, folder),
        "pair_files": os.path.relpath(shop.pairs, folder),
        "split": json.loads(split.to_json())["sha256"],
        "sequences": {
            "kept": len(units),
            "dropped": len(outcomes) - len(units) - failed,
            "failed": failed,
        },
        "pairs": dict(sorted(parts.items())),
        "tables": {name: table_digest(folder / f"{name}.parquet") for name in TABLES},
        "versions": {name: package_version(name) for name in _PACKAGES},
    }
    write_atomic(folder / "manifest.json", (json.dumps(manifest, indent=1) + "\n").encode())


@dataclass(frozen=True)
class _Counts:
    """How many there are of what is stored."""

    frames: Counter[str]
    """By sequence."""
    pairs: Counter[tuple[str, str]]
    """By sequence and split."""


def _write_frames_and_pairs(folder: Path, units: list[Unit]) -> _Counts:
    """Both tables from the sequences' own, one after the other."""
    counts = _Counts(Counter(), Counter())
    with (
        _writer(folder / "frames.parquet") as write_frames,
        _writer(folder / "pairs.parquet") as write_pairs,
    ):
        for unit in units:
            cameras = read_camera_table(unit.frames_folder, unit.frames_key)
            pairs = unit.pair_files.read()
            if cameras is None or pairs is None:
                raise InputError(
                    f"{unit.frames_folder}: vanished or changed meanwhile; run data_prep again"
                )
            write_frames(_frame_rows(unit, cameras))
            write_pairs(pairs.replace_schema_metadata(None))
            counts.frames[unit.name] = cameras.num_rows
            counts.pairs.update((unit.name, part) for part in pairs["split"].to_pylist())
    return counts


def _frame_rows(unit: Unit, cameras: pa.Table) -> pa.Table:
    shares = cameras["depth_share"].to_numpy()
    references = reference_frames(shares, unit.is_lone)
    names = pa.array([unit.name] * cameras.num_rows, pa.string())
    rows = cameras.replace_schema_metadata(None).add_column(0, "sequence", names)
    return rows.append_column("reference", pa.array(references))


def _sequence_rows(outcomes: list[Outcome], split: Split, counts: _Counts) -> pd.DataFrame:
    rows: list[dict[str, Any]] = [
        {
            "sequence": outcome.name,
            **asdict(outcome.verdict),
            **_frame_counts(outcome, counts),
            "failed": outcome.failed,
            "viewpoint_quality": outcome.sequence.viewpoint_quality,
            "point_cloud_quality": outcome.sequence.point_cloud_quality,
            "split": split.role(outcome.name) if outcome.verdict.kept else "",
            "pairs": sum(counts.pairs[outcome.name, part] for part in ("train", "test")),
        }
        for outcome in outcomes
    ]
    return pd.DataFrame(rows)


def _frame_counts(outcome: Outcome, counts: _Counts) -> dict[str, int]:
    """Stored frames, and those that could not be used; of a dropped sequence all that it has."""
    taken = outcome.verdict.frames
    stored = counts.frames[outcome.name] if outcome.verdict.kept else taken
    unread = len(outcome.sequence.left_out)
    return {"frames": stored, "frames_left_out": taken - stored + unread}


class _Rows:
    """Tables of one schema, gathered until it is worth writing them."""

    def __init__(self, file: Path) -> None:
        self.file = file
        self.waiting: list[pa.Table] = []
        self.writer: pq.ParquetWriter | None = None

    def add(self, table: pa.Table) -> None:
        """Take rows, and write what has come together if it is enough."""
        self.waiting.append(table)
        if sum(part.num_rows for part in self.waiting) >= _ROWS_AT_A_TIME:
            self.write()

    def write(self) -> None:
        """Write what waits."""
        if not self.waiting:
            return
        rows = pa.concat_tables(self.waiting)
        self.waiting.clear()
        self.writer = self.writer or pq.ParquetWriter(self.file, rows.schema)
        self.writer.write_table(rows)


@contextmanager
def _writer(file: Path) -> Iterator[Any]:
    """A function that takes the rows of `file`, which is there whole or not at all."""
    temporary = partial_path(file)
    rows = _Rows(temporary)
    try:
        yield rows.add
        rows.write()
        if rows.writer is not None:
            rows.writer.close()
            temporary.replace(file)
    finally:
        temporary.unlink(missing_ok=True)
