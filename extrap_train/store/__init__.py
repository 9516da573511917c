"""Results on disk: manifests, claimed folders, atomic writes, locks, records and digests."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Outcome:
    """The folder of a result, and whether the result was there before."""

    folder: Path
    is_reused: bool = False
