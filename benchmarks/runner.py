"""Run a table: what is missing is made, what is there is used, and the reports are written."""

import json
import os
import statistics
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout
from rich.console import Console
from rich.live import Live
from rich.table import Table

from benchmarks.catalogue import Catalogue
from benchmarks.cells import FAILED, OK, CellJob, died_record, run_cell
from benchmarks.files import json_bytes
from benchmarks.plan import (
    Selection,
    TableFolder,
    cell_jobs,
    open_protocol,
    prepare_draws,
)
from benchmarks.results import read_results
from benchmarks.reuse import finished
from extrap_train.config import SlurmConfig, TableConfig
from extrap_train.data.files import write_whole
from extrap_train.errors import InputError
from extrap_train.jobs import Died, Launcher
from extrap_train.jobs.local import LocalLauncher
from extrap_train.jobs.slurm import slurm_launcher


@dataclass(frozen=True)
class RunOptions:
    """What the command line says beside the table."""

    quick: bool = False
    dry_run: bool = False
    workers: int = 0
    """Processes; 0 takes every core, or one on a GPU."""
    slurm: bool = False
    launcher: Launcher | None = None
    """In place of the above."""


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


def run_table(table: TableConfig, catalogue: Catalogue, options: RunOptions) -> int:
    """Make every missing cell and the reports; returns how many cells have failed.

    Raises InputError where another run holds the folder, or where the table cannot be made.
    """
    console = Console()
    folder = TableFolder(Path(table.output) / table.name)
    _make_folder(folder)
    try:
        with FileLock(folder.path / ".lock", timeout=0):
            return _run(table, catalogue, options, folder, console)
    except Timeout:
        raise InputError(
            f"{folder.path}: another process runs this table; wait for it or give output=FOLDER"
        ) from None


def _make_folder(folder: TableFolder) -> None:
    try:
        folder.path.mkdir(parents=True, exist_ok=True)
        (folder.path / ".writable").touch()
        (folder.path / ".writable").unlink()
    except OSError as error:
        raise InputError(
            f"{folder.path}: cannot be written ({error.strerror}); choose another output="
        ) from None


def _run(
    table: TableConfig,
    catalogue: Catalogue,
    options: RunOptions,
    folder: TableFolder,
    console: Console,
) -> int:
    methods = [_with_options(catalogue, name, table) for name in table.methods]
    if not methods:
        raise InputError("the table has no methods: give methods=[...]")
    protocol, captures = open_protocol(table, folder)
    selection = Selection()
    if options.quick:
        selection = Selection(tuple(table.quick.categories), table.quick.sequences)
    draws = selection.draws(protocol, table.draws)
    if not draws:
        raise InputError(
            f"no draw of {table.draws} in {folder.protocol}; see table and rules.draws"
        )
    scenes = []
    with console.status("") as status:
        for number, scene in enumerate(prepare_draws(table, folder, draws, captures)):
            scenes.append(scene)
            status.update(f"preparing draws: {number + 1} of {len(draws)}")
    jobs = cell_jobs(table, folder, protocol, methods, scenes)
    done, waiting = finished(jobs, folder, console.print)
    console.print(f"{len(jobs)} cells: {len(done)} finished and used again, {len(waiting)} open")
    if options.dry_run:
        _print_plan(jobs, waiting, folder, console)
        return 0
    plan = {
        "table": asdict(table),
        "quick": options.quick,
        "protocol": protocol.sha256,
        "methods": {m.name: {"title": m.title, "group": m.group, "time": m.time} for m in methods},
        "cells": [job.folder.name for job in jobs],
    }
    progress = Progress(len(jobs))
    for job in done:
        progress.note(job.method.name, OK)
    problems = _make(waiting, table, options, folder, progress, console)
    write_whole(folder.plan, json_bytes(plan))
    # Light to import only where it is needed: the reports draw.
    from benchmarks.report import write_reports

    results = read_results(folder)
    written = write_reports(results, catalogue, folder)
    for reason, names in problems.items():
        console.print(f"[bold]{len(names)}[/] cells of {', '.join(sorted(set(names)))}: {reason}")
    for path in written:
        console.print(f"written: {path}")
    console.print(f"result: {folder.path}")
    return sum(1 for cell in results.cells if cell["status"] == FAILED)


def _with_options(catalogue: Catalogue, name: str, table: TableConfig) -> Any:
    method = catalogue.method(name)
    return replace(method, options={**method.options, **table.options.get(name, {})})


def _make(
    waiting: list[CellJob],
    table: TableConfig,
    options: RunOptions,
    folder: TableFolder,
    progress: Progress,
    console: Console,
) -> dict[str, list[str]]:
    """Run the open cells; returns the methods' names by what went wrong."""
    problems: dict[str, list[str]] = defaultdict(list)
    if not waiting:
        return problems
    started = time.perf_counter()
    with (
        _launcher(options, table.slurm, waiting[0].device, folder) as launcher,
        Live(progress.view(len(waiting), 0.0, 0), console=console) as live,
    ):
        for number, (index, result) in enumerate(launcher.run(run_cell, waiting), 1):
            job = waiting[index]
            record = died_record(job, result.reason) if isinstance(result, Died) else result
            progress.note(job.method.name, record["status"])
            if record["status"] != OK:
                problems[record["reason"]].append(job.method.name)
            elapsed = time.perf_counter() - started
            live.update(progress.view(len(waiting) - number, elapsed, number))
    return problems


@contextmanager
def _launcher(
    options: RunOptions, slurm: SlurmConfig, device: str, folder: TableFolder
) -> Iterator[Launcher]:
    if options.launcher is not None:
        yield options.launcher
    elif options.slurm:
        yield slurm_launcher(slurm, folder.path / "slurm")
    else:
        cores = 1 if device == "cuda" else len(os.sched_getaffinity(0))
        with LocalLauncher(options.workers or cores, apart=True) as local:
            yield local


def _print_plan(
    jobs: list[CellJob], waiting: list[CellJob], folder: TableFolder, console: Console
) -> None:
    """What would run, how long by what finished cells took, and what is missing."""
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
