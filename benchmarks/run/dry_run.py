"""What a table's run would do, and how long that takes by what finished cells took."""

import statistics
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field

from rich.console import Console
from rich.table import Table

from benchmarks.run.cells import Cell, CellJob
from benchmarks.run.identity import MISSING_WEIGHTS
from benchmarks.run.plan import OpenJobs, TableFolder
from benchmarks.score.scoring import missing_networks
from extrap_train.errors import InputError
from extrap_train.store.records import read_record


@dataclass
class _Took:
    """Seconds that finished cells of one method took, of any options."""

    making: list[float] = field(default_factory=list)
    scoring: list[float] = field(default_factory=list)


def print_plan(
    jobs: Sequence[CellJob], left: OpenJobs, folder: TableFolder, console: Console
) -> None:
    """What would run, how long, and what is missing: a method's weights, and the networks without
    which a column stays empty.
    """
    took = _by_method(folder)
    everywhere = [second for method in took.values() for second in method.scoring]
    shown = Table("method", "cells", "to make", "to score", "seconds a cell", "missing")
    total, unknown = 0.0, []
    for name in dict.fromkeys(job.method.name for job in jobs):
        counts = [sum(job.method.name == name for job in part) for part in _parts(left)]
        to_make, to_score = counts
        making = _median(took[name].making)
        scoring = _median(took[name].scoring or everywhere)
        total += (making or 0) * to_make + (scoring or 0) * (to_make + to_score)
        if (to_make and making is None) or (to_score and scoring is None):
            unknown.append(name)
        mine = [job for job in jobs if job.method.name == name]
        weights = mine[0].made_from.inputs["weights"]
        is_missing = weights.startswith(MISSING_WEIGHTS)
        missing = weights.removeprefix(MISSING_WEIGHTS) if is_missing else ""
        rate = "not yet known" if making is None else f"{making + (scoring or 0):.1f}"
        shown.add_row(name, str(len(mine)), *map(str, counts), rate, missing)
    console.print(shown)
    for column, reason in missing_networks(jobs[0].scoring).items():
        console.print(f"{column} stays empty: {reason}")
    known = [f"about {_duration(total)} of one core"] if total or not unknown else []
    more = [f"no finished cell tells how long {', '.join(unknown)} will take"] if unknown else []
    console.print("; ".join([*known, *more]))


def _parts(left: OpenJobs) -> tuple[list[CellJob], list[CellJob]]:
    return left.to_make, left.to_score


def _median(seconds: list[float]) -> float | None:
    return statistics.median(seconds) if seconds else None


def _by_method(folder: TableFolder) -> dict[str, _Took]:
    took: dict[str, _Took] = defaultdict(_Took)
    for file in folder.cells.glob("*/cell.json"):
        try:
            cell = read_record(file, Cell, "")
        except InputError:
            continue
        if cell.images:
            took[cell.method].making.append(cell.wall_seconds)
        if cell.scoring_seconds is not None:
            took[cell.method].scoring.append(cell.scoring_seconds)
    return took


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {rest} s"
