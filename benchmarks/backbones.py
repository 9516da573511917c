"""The weights of the perceptual metrics: which file judges a column, wherever it comes from."""

from collections.abc import Mapping
from pathlib import Path

from benchmarks.fingerprint import weights_hash
from extrap_train.config import ScoringConfig
from extrap_train.metrics import BACKBONES, hub_cache


def columns_of(scoring: ScoringConfig) -> list[str]:
    """The columns that a network judges."""
    return [*(f"lpips_{net}" for net in scoring.lpips), *(["dists"] if scoring.dists else [])]


def judging_files(scoring: ScoringConfig) -> dict[str, Path]:
    """By column, the file that judges: the one that is named, there or not, or else the one in
    torch's hub cache. A column without either is left out.
    """
    named = {
        f"lpips_{net}": Path(scoring.lpips_weights[net])
        for net in scoring.lpips
        if net in scoring.lpips_weights
    }
    cached = {column: _cached(column) for column in columns_of(scoring) if column not in named}
    return named | {column: file for column, file in cached.items() if file.is_file()}


def _cached(column: str) -> Path:
    return hub_cache() / BACKBONES["vgg" if column == "dists" else column.removeprefix("lpips_")]


def judging_hashes(scoring: ScoringConfig) -> Mapping[str, str]:
    """SHA-256 of what judges, by column; raises InputError where a named file is missing."""
    return {column: weights_hash([file]) for column, file in judging_files(scoring).items()}
