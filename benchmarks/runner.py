"""Run a table: what is missing is made, what is there is used, and the reports are written."""

import os
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.live import Live

from benchmarks.backbones import judging_hashes
from benchmarks.catalogue import Catalogue
from benchmarks.cells import FAILED, OK, CellJob, died_record, run_cell
from benchmarks.files import json_bytes
from benchmarks.plan import (
    TableFolder,
    cell_jobs,
    open_protocol,
    prepare_draws,
    selected_draws,
)
from benchmarks.progress import Progress, print_plan
from benchmarks.protocol import Protocol
from benchmarks.results import read_results
from benchmarks.reuse import finished
from extrap_train.config import MethodConfig, SlurmConfig, TableConfig
from extrap_train.errors import InputError
from extrap_train.jobs import Died, Launcher
from extrap_train.jobs.local import LocalLauncher
from extrap_train.jobs.slurm import slurm_launcher
from extrap_train.store.atomic import file_lock, write_atomic
from extrap_train.terminal import terminal


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


def run_table(table: TableConfig, catalogue: Catalogue, options: RunOptions) -> int:
    """Make every missing cell and the reports; returns how many cells have failed.

    Raises InputError where another run holds the folder, or where the table cannot be made.
    """
    console = terminal()
    folder = TableFolder(Path(table.output) / table.name)
    _make_folder(folder)
    taken = f"{folder.path}: another process runs this table; wait for it or give output=FOLDER"
    with file_lock(folder.path / ".lock", taken):
        return _run(table, catalogue, options, folder, console)


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
    protocol, captures = open_protocol(table, folder, methods)
    draws = selected_draws(table, protocol, options.quick)
    scenes = []
    with console.status("") as status:
        for number, scene in enumerate(prepare_draws(table, folder, draws, captures)):
            scenes.append(scene)
            status.update(f"preparing draws: {number + 1} of {len(draws)}")
    jobs = cell_jobs(table, folder, protocol, methods, scenes)
    done, waiting = finished(jobs, folder, console.print)
    console.print(f"{len(jobs)} cells: {len(done)} finished and used again, {len(waiting)} open")
    if options.dry_run:
        print_plan(jobs, waiting, folder, console)
        return 0
    plan = _plan(table, options, protocol, methods, jobs)
    progress = Progress(len(jobs))
    for job in done:
        progress.note(job.method.name, OK)
    problems = _make(waiting, table, options, folder, progress, console)
    write_atomic(folder.plan, json_bytes(plan))
    # Light to import only where it is needed: the reports draw.
    from benchmarks.report import write_reports

    results = read_results(folder)
    written = write_reports(results, catalogue, folder)
    for reason, names in problems.items():
        console.print(f"{len(names)} cells of {', '.join(sorted(set(names)))}: {reason}")
    for path in written:
        console.print(f"written: {path}")
    console.print(f"result: {folder.path}")
    return sum(1 for cell in results.cells if cell["status"] == FAILED)


def _plan(
    table: TableConfig,
    options: RunOptions,
    protocol: Protocol,
    methods: list[MethodConfig],
    jobs: list[CellJob],
) -> dict[str, Any]:
    """What the results are of: all that reports and verification ask beside the cells."""
    return {
        "table": asdict(table),
        "quick": options.quick,
        "protocol": protocol.sha256,
        "networks": judging_hashes(table.scoring),
        "methods": {method.name: asdict(method) for method in methods},
        "cells": [job.folder.name for job in jobs],
    }


def _with_options(catalogue: Catalogue, name: str, table: TableConfig) -> MethodConfig:
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
