"""What a task returns. Imports nothing, so that `--help` stays instant."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Outcome:
    """The folder of a result, and whether the result was there before."""

    folder: Path
    is_reused: bool = False
