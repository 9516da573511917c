"""Preparation of a category: filter, frames with depth, split, pairs, tables."""

import errno
import hashlib
import json
import logging
import shutil
from collections import Counter
from collections.abc import Collection
from collections.abc import Sequence as ListOf
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path

from tqdm import tqdm

from data_prep.filter import Verdict, judge_all
from data_prep.frames import frames_key, make_frames
from data_prep.split import split_sequences
from data_prep.tables import Outcome, write_results
from extrap_train.config import PrepConfig
from extrap_train.data.frame_files import frames_folder, read_camera_table, write_frames
from extrap_train.data.sequences import Sequence
from extrap_train.data.store import FORMAT, PreparedData, read_manifest
from extrap_train.depth import DepthSource
from extrap_train.errors import InputError

LOG = logging.getLogger(__name__)

_BYTES_PER_PIXEL = 3 + 2 + 1
"""Of a stored frame: colours, depth, mask."""
_NO_SPACE = (errno.ENOSPC, errno.EDQUOT)


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
        write_results(folder, outcomes, split, options, key)
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
        digest.update(frames_key(sequence, depth_source, options.image_size, False).encode())
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

    verdicts = judge_all(sequences, options)
    kept = Counter(
        s.category for s, verdict in zip(sequences, verdicts, strict=True) if verdict.kept
    )

    def make(sequence: Sequence, verdict: Verdict) -> Outcome:
        lone = kept[sequence.category] == 1
        return _make(sequence, verdict, depth_source, options, folder, lone)

    folder.mkdir(parents=True, exist_ok=True)
    with ThreadPoolExecutor(workers) as pool:
        done = tqdm(
            pool.map(make, sequences, verdicts),
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
    lone: bool,
) -> Outcome:
    if not verdict.kept:
        return Outcome(sequence, verdict, None)
    target = frames_folder(folder, f"{sequence.category}/{sequence.name}")
    key = frames_key(sequence, depth_source, options.image_size, lone)
    cameras = read_camera_table(target, key)
    if cameras is None:
        try:
            frames = make_frames(sequence, depth_source, options.image_size, lone)
        except InputError as error:
            failed = Verdict(
                False, str(error), verdict.frames, verdict.gap_deg, verdict.coverage_deg
            )
            return Outcome(sequence, failed, None)
        write_frames(target, frames, key)
        cameras = read_camera_table(target, key)
    return Outcome(sequence, verdict, cameras)


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
