"""The preparation of one sequence: its frames with depth, then its pairs with their corrections.

A job reads the sequence's photographs and writes the sequence's folders. Finished folders are left
alone, so running a job twice costs nothing.
"""

import errno
import hashlib
import json
import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import torch
from jaxtyping import Bool, Float

from data_prep.correct import CORRECTION_VERSION, correct_pair
from data_prep.model_cache import PrepModels
from data_prep.select import select_pairs
from extrap_train.config import PrepConfig
from extrap_train.data.frame_files import (
    CAMERAS,
    FLOWS,
    SealedTable,
    StoredFrames,
    frames_folder,
    pairs_folder,
    write_frames,
)
from extrap_train.data.sequences import FrameSequence
from extrap_train.data.square_frames import held_out_mask, make_frames
from extrap_train.device import is_out_of_memory
from extrap_train.errors import InputError
from extrap_train.geometry.viewpoints import pairwise_angles, scene_center
from extrap_train.matching import Matcher
from extrap_train.terminal import track

LOG = logging.getLogger(__name__)
MIN_DEPTH_SHARE = 0.02
"""A frame with less of its depth known cannot be a reference: its warp would be empty."""
PAIRS = "pairs.parquet"
_OPTIONS = (
    "max_uses",
    "min_pair_angle_deg",
    "max_pair_angle_deg",
    "near_duplicate_deg",
    "correction_grid",
)
NO_SPACE = (errno.ENOSPC, errno.EDQUOT)
"""What ends the whole run: the next sequence would not fit either."""


def pair_options(options: PrepConfig) -> dict[str, Any]:
    """The options that decide about the pairs of a sequence and their corrections."""
    return {name: getattr(options, name) for name in _OPTIONS}


@dataclass(frozen=True)
class PrepContext:
    """What all jobs of a preparation share; small, because every job carries it."""

    models: PrepModels
    options: PrepConfig
    frames_root: Path
    """Preparations with other pair options share the frames here."""
    pairs_root: Path
    """Preparations of other sequences share the pairs and corrections here."""

    @property
    def correction(self) -> str:
        """How warps are corrected; empty where they are not."""
        identity = self.models.correction_identity
        return identity and f"{identity}, version {CORRECTION_VERSION}"


@dataclass(frozen=True)
class SequenceJob:
    """One sequence to prepare, and its role."""

    context: PrepContext
    sequence: FrameSequence
    role: str
    """`train`, `test` or `train and test` (`split.SequenceSplit.role`)."""
    capture_key: str
    """What its frames are made from (`CaptureKeys.frames_key`), but for the role."""
    progress: bool = False
    """Whether to show the progress of its pairs, as for a single sequence."""

    @property
    def name(self) -> str:
        """`category/name`, as the prepared data calls it."""
        return f"{self.sequence.category}/{self.sequence.name}"

    @property
    def is_lone(self) -> bool:
        """Whether frames of it are held out."""
        return self.role == "train and test"

    @property
    def frames_key(self) -> str:
        """What the frames are made from."""
        return f"{self.capture_key}{' with frames held out' if self.is_lone else ''}"

    @property
    def frames(self) -> SealedTable:
        """The cameras' table, which seals images, depths and masks."""
        folder = frames_folder(self.context.frames_root, self.name, self.is_lone)
        return SealedTable(folder / CAMERAS, self.frames_key)

    @property
    def pairs(self) -> SealedTable:
        """The pairs' table, which seals their flows."""
        context, folder = self.context, pairs_folder(self.context.pairs_root, self.name, self.role)
        made_from = [self.frames_key, self.role, pair_options(context.options), context.correction]
        content = json.dumps(made_from, sort_keys=True)
        return SealedTable(folder / PAIRS, hashlib.sha256(content.encode()).hexdigest())

    @property
    def is_there(self) -> bool:
        """Whether frames and pairs are whole and made from what is asked for."""
        return self.frames.is_there() and self.pairs.is_there()


def prepare_sequence(job: SequenceJob) -> str:
    """Make the frames and pairs that are missing; returns why the sequence cannot be used, or "".

    An error costs its sequence alone, even if it is a bug; a bug's traceback is logged. A full disk
    is raised, and MemoryError where memory ends, a GPU's or the machine's: other processes may have
    held it, so the launcher tries again.
    """
    try:
        _prepare(job)
    except InputError as error:
        return str(error)
    except OSError as error:
        if error.errno in NO_SPACE:
            raise
        return f"sequence {job.name}: {error}"
    except Exception as error:
        if is_out_of_memory(error):
            # Every launcher knows MemoryError; torch's own error is none.
            raise MemoryError(str(error).split("\n")[0]) from None
        LOG.exception("sequence %s is left out: %r", job.name, error)
        return f"sequence {job.name}: {type(error).__name__}: {error}"
    return ""


def _prepare(job: SequenceJob) -> None:
    options, models = job.context.options, job.context.models
    table = job.frames.read()
    if table is None:
        frames = make_frames(job.sequence, models.depth_source(), options.image_size, job.is_lone)
        write_frames(job.frames, frames)
        table = job.frames.read()
        if table is None:
            raise OSError(f"{job.frames.file.parent}: the disk has not kept what was written")
    if job.pairs.is_there():
        return
    stored = StoredFrames(job.frames.file.parent, table, options.image_size)
    with torch.inference_mode():
        pairs = choose_pairs(stored, job.name, job.role, options)
        grid = options.correction_grid
        pairs, flows = correct_pairs(stored, pairs, models.matcher(), grid, job.progress)
    rows = pa.Table.from_pandas(pairs, preserve_index=False)
    job.pairs.write(rows, {FLOWS: flows.astype(np.float16)})


def reference_frames(depth_share: Float[np.ndarray, " n"], lone: bool) -> Bool[np.ndarray, " n"]:
    """Which frames may be references."""
    known = depth_share >= MIN_DEPTH_SHARE
    return known & ~held_out_mask(len(known)) if lone else known


def choose_pairs(frames: StoredFrames, name: str, role: str, options: PrepConfig) -> pd.DataFrame:
    """A sequence's pairs; a lone sequence has some for training and some for testing."""
    count, lone = len(frames.depth_share), role == "train and test"
    angles = pairwise_angles(frames.camera, scene_center(frames.camera))
    queries = {role: np.ones(count, bool)}
    if lone:
        queries = {"train": ~held_out_mask(count), "test": held_out_mask(count)}
    references = reference_frames(frames.depth_share, lone)
    parts = []
    for split, allowed in queries.items():
        chosen = select_pairs(angles, options, allowed, references)
        rows = pd.DataFrame(vars(chosen)).astype({"reference": "int32", "query": "int32"})
        parts.append(rows.assign(sequence=name, split=split))
    return pd.concat(parts, ignore_index=True)


def correct_pairs(
    frames: StoredFrames,
    pairs: pd.DataFrame,
    matcher: Matcher | None,
    grid: int,
    progress: bool = False,
) -> tuple[pd.DataFrame, Float[np.ndarray, "m 2 g g"]]:
    """The pairs with what correction did for each, and the flows that `flow` numbers.

    Only training pairs are corrected: a correction knows the truth, which a test view must not.
    `flow` is −1 where the warp stays as it is, with the reason in `uncorrected`.
    """
    flows: list[np.ndarray] = []
    rows = []
    columns = [pairs[name] for name in ("reference", "query", "split")]
    bar = track(
        zip(*columns, strict=True),
        "correcting",
        len(pairs),
        "pairs",
        shown=progress and matcher is not None,
    )
    for reference, query, split in bar:
        if matcher is None or split != "train":
            rows.append((-1, np.nan, np.nan, ""))
            continue
        found = correct_pair(frames.view(reference), frames.view(query), matcher, grid)
        number = -1 if found.flow is None else len(flows)
        if found.flow is not None:
            flows.append(found.flow.numpy())
        rows.append((number, found.error_before, found.error_after, found.reason))
    names = ["flow", "error_before", "error_after", "uncorrected"]
    made = pd.DataFrame(rows, columns=names).astype(
        {"flow": "int32", "error_before": "float32", "error_after": "float32"}
    )
    stacked = np.stack(flows) if flows else np.zeros((0, 2, grid, grid), np.float32)
    return pd.concat([pairs, made], axis=1), stacked
