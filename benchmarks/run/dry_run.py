"""What a table's run would do, and how long that takes by what finished cells took."""

from collections import defaultdict
from collections.abc import Sequence
from datetime import timedelta
from statistics import median

from rich.console import Console
from rich.table import Table

from benchmarks.run.cells import Cell, CellJob
from benchmarks.run.identity import MISSING_WEIGHTS
from benchmarks.run.plan import OpenJobs, TableFolder
from benchmarks.score.scoring import missing_networks
from extrap_train.errors import InputError
from extrap_train.store.records import read_record


def print_plan(
    jobs: Sequence[CellJob], left: OpenJobs, folder: TableFolder, console: Console
) -> None:
    """What would run, how long, and what is missing: a method's weights, and the networks without
    which a column stays empty.
    """
    making, scoring = _seconds_by_method(folder)
    everywhere = [second for seconds in scoring.values() for second in seconds]
    shown = Table("method", "cells", "to make", "to score", "seconds a cell", "missing")
    total, unknown = 0.0, []
    for name in dict.fromkeys(job.method.name for job in jobs):
        mine = [job for job in jobs if job.method.name == name]
        to_make, to_score = (
            sum(job.method.name == name for job in part) for part in (left.to_make, left.to_score)
        )
        make_s, score_s = making[name], scoring[name] or everywhere
        if (to_make and not make_s) or (to_score and not score_s):
            unknown.append(name)
        each = median(make_s or [0.0]), median(score_s or [0.0])
        total += each[0] * to_make + each[1] * (to_make + to_score)
        weights = mine[0].made_from.inputs["weights"]
        is_missing = weights.startswith(MISSING_WEIGHTS)
        missing = weights.removeprefix(MISSING_WEIGHTS) if is_missing else ""
        rate = f"{sum(each):.1f}" if make_s else "not yet known"
        shown.add_row(name, *map(str, (len(mine), to_make, to_score)), rate, missing)
    console.print(shown)
    for column, reason in missing_networks(jobs[0].scoring).items():
        console.print(f"{column} stays empty: {reason}")
    duration = timedelta(seconds=round(total))
    known = [f"about {duration} (h:mm:ss) of one core"] if total or not unknown else []
    more = [f"no finished cell tells how long {', '.join(unknown)} will take"] if unknown else []
    console.print("; ".join([*known, *more]))


def _seconds_by_method(
    folder: TableFolder,
) -> tuple[dict[str, list[float]], dict[str, list[float]]]:
    """What making and scoring each finished cell took, of any options."""
    making, scoring = defaultdict(list), defaultdict(list)
    for file in folder.cells.glob("*/cell.json"):
        try:
            cell = read_record(file, Cell, "")
        except InputError:
            continue
        if cell.images:
            making[cell.method].append(cell.wall_seconds)
        if cell.scoring_seconds is not None:
            scoring[cell.method].append(cell.scoring_seconds)
    return making, scoring
