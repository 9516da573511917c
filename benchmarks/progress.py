"""How a table stands: before a run, and while it runs."""

import json
import statistics
from collections import defaultdict
from dataclasses import dataclass, field

from rich.console import Console
from rich.table import Table

from benchmarks.cells import CellJob
from benchmarks.plan import TableFolder
from benchmarks.scoring import missing_networks


@dataclass
class Progress:
    """How a table stands, for the live view."""

    total: int
    counts: dict[str, dict[str, int]] = field(default_factory=lambda: defaultdict(dict))
    seconds: list[float] = field(default_factory=list)

    def note(self, method: str, status: str) -> None:
        """One more cell of a method has this status."""
        row = self.counts[method]
        row[status] = row.get(status, 0) + 1

    def view(self, left: int, elapsed: float, done_now: int) -> Table:
        """The table as it stands, with the expected rest."""
        rest = elapsed / done_now * left if done_now else 0.0
        eta = f", about {_duration(rest)} left" if done_now and left else ""
        shown = Table("method", "ok", "failed", "unavailable", title=f"{left} cells open{eta}")
        for method, row in self.counts.items():
            shown.add_row(method, *(str(row.get(s, 0)) for s in ("ok", "failed", "unavailable")))
        return shown


def print_plan(
    jobs: list[CellJob], waiting: list[CellJob], folder: TableFolder, console: Console
) -> None:
    """What would run, how long by what finished cells took, and what is missing: a method's
    weights, and the networks without which a column stays empty.
    """
    took = _seconds_by_method(folder)
    shown = Table("method", "cells", "open", "seconds a cell", "missing")
    total, unknown = 0.0, []
    for name in dict.fromkeys(job.method.name for job in jobs):
        mine = [job for job in jobs if job.method.name == name]
        still = [job for job in waiting if job.method.name == name]
        seconds = statistics.median(took[name]) if took.get(name) else None
        total += (seconds or 0) * len(still)
        unknown += [name] if seconds is None and still else []
        weights = mine[0].hashes["weights"]
        missing = weights.removeprefix("missing: ") if weights.startswith("missing") else ""
        rate = f"{seconds:.1f}" if seconds is not None else "not yet known"
        shown.add_row(name, str(len(mine)), str(len(still)), rate, missing)
    console.print(shown)
    for column, reason in missing_networks(jobs[0].scoring).items():
        console.print(f"{column} stays empty: {reason}")
    known = [f"about {_duration(total)} of one core"] if total or not unknown else []
    more = [f"no finished cell tells how long {', '.join(unknown)} will take"] if unknown else []
    console.print("; ".join([*known, *more]))


def _seconds_by_method(folder: TableFolder) -> dict[str, list[float]]:
    """Wall time of finished cells of any options, from their records."""
    took: dict[str, list[float]] = defaultdict(list)
    for file in folder.cells.glob("*/cell.json"):
        try:
            record = json.loads(file.read_text())
            took[record["method"]].append(float(record["wall_seconds"]))
        except (OSError, ValueError, KeyError):
            continue
    return took


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {rest} s"
