"""A cell that is to be made or scored."""

from dataclasses import dataclass
from pathlib import Path

from benchmarks.protocol import Draw
from benchmarks.records import Hashes
from extrap_train.config import MethodConfig, ScoringConfig


@dataclass(frozen=True)
class CellJob:
    """All that making and scoring one cell take."""

    folder: Path
    """Its name is the key."""
    scene: Path
    draw: Draw
    method: MethodConfig
    scoring: ScoringConfig
    device: str
    hashes: Hashes
    images_from: Path | None = None
    """A cell with the very same images, which only need scoring."""
