"""Preparation of a category: filter, frames with depth, split, pairs, tables."""

import errno
import hashlib
import json
import logging
import shutil
from collections import Counter
from collections.abc import Collection, Iterable
from collections.abc import Sequence as ListOf
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from tqdm import tqdm

from data_prep.filter import Verdict, judge_all
from data_prep.frames import frames_key, make_frames
from data_prep.select import select_pairs
from data_prep.split import Split, held_out, split_sequences
from extrap_train.config import PrepConfig
from extrap_train.data.files import write_whole
from extrap_train.data.frame_files import frames_folder, read_camera_table, write_frames
from extrap_train.data.sequences import Sequence
from extrap_train.data.store import FORMAT, PreparedData, matrices_of, read_manifest
from extrap_train.depth import DepthSource
from extrap_train.errors import InputError
from extrap_train.geometry.viewpoints import pairwise_angles, scene_center
from extrap_train.views import Camera

LOG = logging.getLogger(__name__)

MIN_DEPTH_SHARE = 0.02
"""A frame with less of its depth known cannot be a reference: its warp would be empty."""
_BYTES_PER_PIXEL = 3 + 2 + 1
"""Of a stored frame: colours, depth, mask."""
_NO_SPACE = (errno.ENOSPC, errno.EDQUOT)


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


def prepare(
    sequences: ListOf[Sequence],
    depth_source: DepthSource,
    options: PrepConfig,
    *,
    test_names: Collection[str] | int,
    folder: Path,
    workers: int = 1,
    progress: bool = True,
) -> PreparedData:
    """Make pair data from sequences, or open what an equal earlier call has made.

    A sequence that cannot be used is dropped with its reason; finished sequences are kept if the
    call is repeated. Raises InputError where no sequence is left, or the disk is full.
    """
    key = _preparation_key(sequences, depth_source, options, test_names)
    if _is_finished(folder, key):
        LOG.info("%s is prepared already and used as it is", folder)
        return PreparedData.open(folder)
    try:
        (folder / "manifest.json").unlink(missing_ok=True)
        outcomes = _make_all(sequences, depth_source, options, folder, workers, progress)
        kept = [outcome for outcome in outcomes if outcome.cameras is not None]
        if not kept:
            raise InputError(_nothing_left(outcomes))
        split = split_sequences([outcome.name for outcome in kept], test_names)
        _write_results(folder, outcomes, split, options, key)
    except OSError as error:
        if error.errno not in _NO_SPACE:
            raise
        raise InputError(_disk_full(folder, sequences, options)) from None
    return PreparedData.open(folder)


def _preparation_key(
    sequences: ListOf[Sequence],
    depth_source: DepthSource,
    options: PrepConfig,
    test_names: Collection[str] | int,
) -> str:
    test = test_names if isinstance(test_names, int) else sorted(test_names)
    digest = hashlib.sha256(json.dumps([FORMAT, asdict(options), test]).encode())
    for sequence in sequences:
        qualities = [sequence.viewpoint_quality, sequence.point_cloud_quality]
        digest.update(json.dumps([sequence.category, sequence.name, qualities]).encode())
        digest.update(frames_key(sequence, depth_source, options.image_size).encode())
    return digest.hexdigest()


def _is_finished(folder: Path, key: str) -> bool:
    return (folder / "manifest.json").exists() and read_manifest(folder).get("key") == key


def _make_all(
    sequences: ListOf[Sequence],
    depth_source: DepthSource,
    options: PrepConfig,
    folder: Path,
    workers: int,
    progress: bool,
) -> list[Outcome]:
    """Threads, not processes: decoding and depth release the interpreter lock."""

    def make(sequence: Sequence, verdict: Verdict) -> Outcome:
        return _make(sequence, verdict, depth_source, options, folder)

    folder.mkdir(parents=True, exist_ok=True)
    with ThreadPoolExecutor(workers) as pool:
        done = tqdm(
            pool.map(make, sequences, judge_all(sequences, options)),
            "preparing",
            len(sequences),
            unit="sequence",
            disable=not progress,
        )
        try:
            return list(done)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _make(
    sequence: Sequence,
    verdict: Verdict,
    depth_source: DepthSource,
    options: PrepConfig,
    folder: Path,
) -> Outcome:
    if not verdict.kept:
        return Outcome(sequence, verdict, None)
    target = frames_folder(folder, f"{sequence.category}/{sequence.name}")
    key = frames_key(sequence, depth_source, options.image_size)
    cameras = read_camera_table(target, key)
    if cameras is None:
        try:
            frames = make_frames(sequence, depth_source, options.image_size)
        except InputError as error:
            failed = Verdict(
                False, str(error), verdict.frames, verdict.gap_deg, verdict.coverage_deg
            )
            return Outcome(sequence, failed, None)
        write_frames(target, frames, key)
        cameras = read_camera_table(target, key)
    return Outcome(sequence, verdict, cameras)


def _write_results(
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


def _nothing_left(outcomes: list[Outcome]) -> str:
    if not outcomes:
        return "no sequence to prepare; check the category and the data set's root"
    reasons = Counter(outcome.verdict.reason for outcome in outcomes).most_common(3)
    listed = "; ".join(f"{count} times {reason}" for reason, count in reasons)
    return (
        f"none of the {len(outcomes)} sequences of {outcomes[0].sequence.category} can be used: "
        f"{listed}. Loosen prep.* (prep.full_circle=ignore keeps partial turns) or add sequences"
    )


def _disk_full(folder: Path, sequences: ListOf[Sequence], options: PrepConfig) -> str:
    frames = sum(len(sequence.frames) for sequence in sequences)
    needed = frames * options.image_size**2 * _BYTES_PER_PIXEL / 2**20
    free = shutil.disk_usage(folder.parent).free / 2**20
    return (
        f"{folder}: no space left on the device ({free:.0f} MiB free, up to {needed:.0f} MiB "
        "needed in all); free some or choose another output=, finished sequences are kept"
    )
