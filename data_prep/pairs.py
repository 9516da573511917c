"""The pairs of one sequence with their corrections: a file of their own, made once."""

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
from jaxtyping import Bool, Float

from data_prep.correct import correct_pair
from data_prep.select import select_pairs
from extrap_train.config import PrepConfig
from extrap_train.data.frame_files import (
    FLOWS,
    StoredFrames,
    is_sealed,
    pairs_folder,
    read_sealed,
    write_sealed,
)
from extrap_train.data.square_frames import held_out_mask
from extrap_train.geometry.viewpoints import pairwise_angles, scene_center
from extrap_train.matching import Matcher
from extrap_train.store.atomic import atomic_folder
from extrap_train.terminal import track

MIN_DEPTH_SHARE = 0.02
"""A frame with less of its depth known cannot be a reference: its warp would be empty."""
TABLE = "pairs.parquet"
_OPTIONS = (
    "max_uses",
    "min_pair_angle_deg",
    "max_pair_angle_deg",
    "near_duplicate_deg",
    "correction_grid",
)


def pair_options(options: PrepConfig) -> dict[str, Any]:
    """The options that decide about the pairs of a sequence and their corrections."""
    return {name: getattr(options, name) for name in _OPTIONS}


@dataclass(frozen=True)
class PairFiles:
    """Where the pairs of a sequence lie, and what they are made from."""

    folder: Path
    key: str

    @classmethod
    def of(
        cls,
        root: Path,
        sequence: str,
        frames_key: str,
        role: str,
        options: PrepConfig,
        correction: str,
    ) -> "PairFiles":
        """`correction` identifies what the warps are corrected with; "" where they are not."""
        content = json.dumps([frames_key, role, pair_options(options), correction], sort_keys=True)
        key = hashlib.sha256(content.encode()).hexdigest()
        return cls(pairs_folder(root, sequence, role), key)

    def are_there(self) -> bool:
        """Whole, and made from what the key says."""
        return is_sealed(self.folder / TABLE, self.key)

    def read(self) -> pa.Table | None:
        """A row a pair, if they are there."""
        return read_sealed(self.folder / TABLE, self.key)

    def write(self, pairs: pd.DataFrame, flows: Float[np.ndarray, "m 2 g g"]) -> None:
        """Both files, whole or not at all."""
        with atomic_folder(self.folder, lambda _: self.are_there()) as made:
            table = pa.Table.from_pandas(pairs, preserve_index=False)
            write_sealed(table, made / TABLE, self.key, {FLOWS: flows.astype(np.float16)})


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
        found = correct_pair(
            frames.image(reference),
            frames.depth(reference),
            frames.camera[reference],
            frames.image(query),
            frames.camera[query],
            matcher,
            grid,
        )
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
