"""The tables of prepared data: sequences with their verdicts, frames, pairs, and the manifest."""

import json
import os
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from data_prep.filter import Verdict
from data_prep.sequence_job import PrepContext, SequenceJob, reference_frames
from data_prep.split import SequenceSplit
from extrap_train.data.frame_files import SealedTable, table_digest
from extrap_train.data.prepared import FORMAT, TABLES
from extrap_train.data.sequences import FrameSequence
from extrap_train.errors import InputError
from extrap_train.store.atomic import atomic_file, write_atomic
from extrap_train.store.manifest import package_version

_PACKAGES = ("extrap-train", "numpy", "opencv-python-headless", "pyarrow", "torch")
"""Whose versions may show in what is stored."""
_ROWS_AT_A_TIME = 50_000
"""Rows that are gathered before they are written: memory does not grow with the sequences."""


@dataclass(frozen=True)
class SequenceOutcome:
    """What became of a sequence."""

    sequence: FrameSequence
    capture_key: str
    """What its frames are made from (`CaptureKeys.frames_key`)."""
    verdict: Verdict
    failed: bool = False
    """Whether it was good enough, but could not be prepared."""

    @property
    def name(self) -> str:
        """`category/name`, as the prepared data calls it."""
        return f"{self.sequence.category}/{self.sequence.name}"

    def job(self, context: PrepContext, role: str, *, progress: bool = False) -> SequenceJob:
        """The preparation of the sequence for a role."""
        return SequenceJob(context, self.sequence, role, self.capture_key, progress)


def write_results(
    folder: Path,
    context: PrepContext,
    outcomes: list[SequenceOutcome],
    split: SequenceSplit,
    facts: Mapping[str, Any],
) -> None:
    """All tables, then the manifest, whose presence marks them complete.

    The manifest also holds `facts`: what the data was made from.
    """
    kept = [outcome for outcome in outcomes if outcome.verdict.kept]
    jobs = [outcome.job(context, split.role(outcome.name)) for outcome in kept]
    frames: Counter[str] = Counter()
    pairs: Counter[tuple[str, str]] = Counter()
    _write_table(folder / "frames.parquet", _frame_tables(jobs, frames))
    _write_table(folder / "pairs.parquet", _pair_tables(jobs, pairs))
    parts: Counter[str] = Counter()
    for (_, part), count in pairs.items():
        parts[part] += count
    if not parts["train"]:
        raise InputError(
            f"{folder}: no two frames of the {len(jobs)} kept sequences make a training pair; "
            "widen prep.min_pair_angle_deg and prep.max_pair_angle_deg, or add photographs"
        )
    rows = [_sequence_row(outcome, split, frames, pairs) for outcome in outcomes]
    table = pa.Table.from_pandas(pd.DataFrame(rows), preserve_index=False)
    _write_table(folder / "sequences.parquet", iter([table]))
    write_atomic(folder / "split.json", split.to_json().encode())
    failed, models = sum(outcome.failed for outcome in outcomes), context.models
    manifest = {
        "format": FORMAT,
        **facts,
        "depth": repr(models.depth),
        "options": asdict(context.options),
        "correction": None if models.correction is None else repr(models.correction),
        "frames": os.path.relpath(context.frames_root, folder),
        "pair_files": os.path.relpath(context.pairs_root, folder),
        "split": json.loads(split.to_json())["sha256"],
        "sequences": {
            "kept": len(jobs),
            "dropped": len(outcomes) - len(jobs) - failed,
            "failed": failed,
        },
        "pairs": dict(sorted(parts.items())),
        "tables": {name: table_digest(folder / f"{name}.parquet") for name in TABLES},
        "versions": {name: package_version(name) for name in _PACKAGES},
    }
    write_atomic(folder / "preparation.json", (json.dumps(manifest, indent=1) + "\n").encode())


def _frame_tables(jobs: list[SequenceJob], counts: Counter[str]) -> Iterator[pa.Table]:
    """Each sequence's frames; counts them by sequence."""
    for job in jobs:
        cameras = _read(job.frames)
        counts[job.name] = cameras.num_rows
        references = reference_frames(cameras["depth_share"].to_numpy(), job.is_lone)
        names = pa.array([job.name] * cameras.num_rows, pa.string())
        rows = cameras.replace_schema_metadata(None).add_column(0, "sequence", names)
        yield rows.append_column("reference", pa.array(references))


def _pair_tables(jobs: list[SequenceJob], counts: Counter[tuple[str, str]]) -> Iterator[pa.Table]:
    """Each sequence's pairs; counts them by sequence and split."""
    for job in jobs:
        pairs = _read(job.pairs)
        counts.update((job.name, part) for part in pairs["split"].to_pylist())
        yield pairs.replace_schema_metadata(None)


def _read(sealed: SealedTable) -> pa.Table:
    table = sealed.read()
    if table is None:
        raise InputError(
            f"{sealed.file.parent}: vanished or changed meanwhile; run data_prep again"
        )
    return table


def _sequence_row(
    outcome: SequenceOutcome,
    split: SequenceSplit,
    frames: Counter[str],
    pairs: Counter[tuple[str, str]],
) -> dict[str, Any]:
    """`frames` counts those that are stored; of a dropped sequence, all that it has."""
    verdict, sequence = outcome.verdict, outcome.sequence
    stored = frames[outcome.name] if verdict.kept else verdict.frames
    return {
        "sequence": outcome.name,
        **asdict(verdict),
        "frames": stored,
        "frames_left_out": verdict.frames - stored + len(sequence.left_out),
        "failed": outcome.failed,
        "viewpoint_quality": sequence.viewpoint_quality,
        "point_cloud_quality": sequence.point_cloud_quality,
        "split": split.role(outcome.name) if verdict.kept else "",
        "pairs": sum(pairs[outcome.name, part] for part in ("train", "test")),
    }


def _write_table(file: Path, parts: Iterator[pa.Table]) -> None:
    """Write the parts, of which there is at least one, as one table."""
    first = next(parts)
    waiting, rows = [first], first.num_rows
    with atomic_file(file) as temporary, pq.ParquetWriter(temporary, first.schema) as writer:
        for part in parts:
            if rows >= _ROWS_AT_A_TIME:
                writer.write_table(pa.concat_tables(waiting))
                waiting, rows = [], 0
            waiting.append(part)
            rows += part.num_rows
        writer.write_table(pa.concat_tables(waiting))
