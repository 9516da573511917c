"""The tables of prepared data: sequences with their verdicts, frames, pairs, and the manifest."""

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from data_prep.filter import Verdict
from data_prep.select import select_pairs
from data_prep.split import Split, held_out
from extrap_train.config import PrepConfig
from extrap_train.data.files import write_whole
from extrap_train.data.sequences import Sequence
from extrap_train.data.store import FORMAT, matrices_of
from extrap_train.errors import InputError
from extrap_train.geometry.viewpoints import pairwise_angles, scene_center
from extrap_train.views import Camera

MIN_DEPTH_SHARE = 0.02
"""A frame with less of its depth known cannot be a reference: its warp would be empty."""


@dataclass(frozen=True)
class Outcome:
    """What became of a sequence."""

    sequence: Sequence
    verdict: Verdict
    cameras: pa.Table | None
    """A row a frame; None where the sequence was dropped."""

    @property
    def name(self) -> str:
        """`category/name`, as the prepared data calls it."""
        return f"{self.sequence.category}/{self.sequence.name}"


def write_results(
    folder: Path, outcomes: list[Outcome], split: Split, options: PrepConfig, key: str
) -> None:
    """All tables, then the manifest, whose presence says that they are complete."""
    kept = [outcome for outcome in outcomes if outcome.cameras is not None]
    references = {outcome.name: _references(outcome, split) for outcome in kept}
    pairs = pd.concat([_pairs(outcome, split, references, options) for outcome in kept])
    if not (pairs["split"] == "train").any():
        raise InputError(
            f"{folder}: no two frames of the {len(kept)} kept sequences make a training pair; "
            "widen prep.min_pair_angle_deg and prep.max_pair_angle_deg, or add photographs"
        )
    frames = pa.concat_tables([_frame_rows(outcome, references[outcome.name]) for outcome in kept])
    _write_table(folder / "frames.parquet", frames)
    _write_table(folder / "pairs.parquet", pa.Table.from_pandas(pairs, preserve_index=False))
    sequences = _sequence_rows(outcomes, split, pairs)
    _write_table(
        folder / "sequences.parquet", pa.Table.from_pandas(sequences, preserve_index=False)
    )
    write_whole(folder / "split.json", split.to_json().encode())
    manifest = {
        "format": FORMAT,
        "key": key,
        "options": asdict(options),
        "split": json.loads(split.to_json())["sha256"],
        "sequences": {"kept": len(kept), "dropped": len(outcomes) - len(kept)},
        "pairs": pairs["split"].value_counts().to_dict(),
        "versions": {name: version(name) for name in ("numpy", "torch", "pyarrow")},
    }
    write_whole(folder / "manifest.json", (json.dumps(manifest, indent=1) + "\n").encode())


def _references(outcome: Outcome, split: Split) -> np.ndarray:
    """Which frames may be references."""
    assert outcome.cameras is not None
    known = outcome.cameras["depth_share"].to_numpy() >= MIN_DEPTH_SHARE
    return known & ~held_out(len(known)) if outcome.name in split.lone else known


def _pairs(
    outcome: Outcome, split: Split, references: dict[str, np.ndarray], options: PrepConfig
) -> pd.DataFrame:
    """A sequence's pairs; a lone sequence has some for training and some for testing."""
    assert outcome.cameras is not None
    frames = outcome.cameras.num_rows
    camera = Camera(
        matrices_of(outcome.cameras, "world_to_cam", (4, 4)),
        matrices_of(outcome.cameras, "intrinsics", (3, 3)),
        options.image_size,
        options.image_size,
    )
    angles = pairwise_angles(camera, scene_center(camera))
    if outcome.name in split.lone:
        queries = {"train": ~held_out(frames), "test": held_out(frames)}
    else:
        queries = {split.role(outcome.name): np.ones(frames, bool)}
    parts = []
    for part, allowed in queries.items():
        chosen = select_pairs(angles, options, allowed, references[outcome.name])
        rows = pd.DataFrame(vars(chosen)).astype({"reference": "int32", "query": "int32"})
        parts.append(rows.assign(sequence=outcome.name, split=part))
    return pd.concat(parts)


def _frame_rows(outcome: Outcome, references: np.ndarray) -> pa.Table:
    assert outcome.cameras is not None
    names = pa.array([outcome.name] * outcome.cameras.num_rows, pa.string())
    rows = outcome.cameras.replace_schema_metadata(None).add_column(0, "sequence", names)
    return rows.append_column("reference", pa.array(references))


def _sequence_rows(outcomes: Iterable[Outcome], split: Split, pairs: pd.DataFrame) -> pd.DataFrame:
    counts = pairs["sequence"].value_counts()
    rows: list[dict[str, Any]] = [
        {
            "sequence": outcome.name,
            **asdict(outcome.verdict),
            "kept": outcome.cameras is not None,
            "viewpoint_quality": outcome.sequence.viewpoint_quality,
            "point_cloud_quality": outcome.sequence.point_cloud_quality,
            "split": split.role(outcome.name) if outcome.cameras is not None else "",
            "pairs": int(counts.get(outcome.name, 0)),
        }
        for outcome in outcomes
    ]
    return pd.DataFrame(rows)


def _write_table(file: Path, table: pa.Table) -> None:
    temporary = file.with_name(f".{file.name}.tmp")
    try:
        pq.write_table(table, temporary)
        temporary.replace(file)
    finally:
        temporary.unlink(missing_ok=True)
