"""The numbers of a cell, and what they tell of methods."""

from dataclasses import dataclass, field

from benchmarks.protocol.array_files import Number


@dataclass(frozen=True)
class Score:
    """A metric's mean over a cell's targets; None where it has none, and why."""

    value: Number | None
    reason: str = ""
    per_image: list[Number | None] = field(default_factory=list)
    """By target, where the metric is one of single images."""
