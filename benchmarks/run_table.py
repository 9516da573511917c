"""Run a table: what is missing is made and scored, what is there is used, reports are written."""

import math
import shutil
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from dataclasses import dataclass, replace
from datetime import timedelta
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
from rich.console import Console
from rich.table import Table

from benchmarks.catalogue import Catalogue
from benchmarks.protocol.draws import write_sealed
from benchmarks.protocol.prepared_scene import Scene, truths_removed
from benchmarks.report.aggregate import read_results
from benchmarks.run.cells import (
    FAILED,
    MADE,
    OK,
    Cell,
    CellJob,
    Plan,
    failed_output,
    keep_output,
    score_cell,
)
from benchmarks.run.identity import MISSING_WEIGHTS, is_ours, method_contents
from benchmarks.run.plan import (
    OpenJobs,
    TableFolder,
    cell_jobs,
    device_of,
    open_jobs,
    open_protocol,
    prepare_draws,
    require_different,
    selected_draws,
)
from benchmarks.run.run_method import check_output, run_method
from benchmarks.score.scoring import missing_networks
from extrap_train.config import FilesDepthConfig, MethodConfig, TableConfig
from extrap_train.errors import InputError
from extrap_train.jobs import Died, Launcher, available_cores
from extrap_train.jobs.isolated import IsolatedJob, IsolatedLauncher
from extrap_train.jobs.local import LocalLauncher
from extrap_train.store.atomic import file_lock, remove_leftovers
from extrap_train.store.records import read_record
from extrap_train.terminal import progress, terminal

_CELLS_PER_SCORER = 8
Making = Callable[[Sequence[CellJob]], Iterator[tuple[int, bytes | Died]]]
"""Runs `run_method` on every job; yields each one's index with its output."""


@dataclass(frozen=True)
class RunOptions:
    """Options of `benchmark run` besides the table's own."""

    quick: bool = False
    dry_run: bool = False
    workers: int = 0
    """Processes; 0 takes every core, or one on a GPU."""
    launcher: Launcher | None = None
    """Where cells are made and scored instead of in processes here."""


def run_table(table: TableConfig, catalogue: Catalogue, options: RunOptions) -> int:
    """Make every missing cell and the reports; returns how many cells have failed.

    Raises InputError where another run holds the folder, or where the table cannot be made.
    """
    folder = TableFolder(Path(table.output) / table.name)
    with _lock_folder(folder):
        return _run(table, catalogue, options, folder, terminal())


@contextmanager
def _lock_folder(folder: TableFolder) -> Iterator[None]:
    """The folder for this process alone, without what killed runs have left in it."""
    taken = f"{folder.path}: another process runs this table; wait for it or give output=FOLDER"
    with ExitStack() as held:
        try:
            folder.path.mkdir(parents=True, exist_ok=True)
            held.enter_context(file_lock(folder.path / ".run.lock", taken))
        except OSError as error:
            raise InputError(
                f"{folder.path}: cannot be written ({error.strerror}); choose another output="
            ) from None
        remove_leftovers(folder.path)
        for place in (folder.cells, folder.scenes, folder.truths):
            for left in filter(Path.is_dir, place.glob(".*")):  # nobody else writes here
                shutil.rmtree(left)
        yield


def _run(
    table: TableConfig,
    catalogue: Catalogue,
    options: RunOptions,
    folder: TableFolder,
    console: Console,
) -> int:
    configs = [catalogue.method(name, table.options.get(name)) for name in table.methods]
    require_different(configs)
    if not configs:
        raise InputError("the table has no methods: give methods=[...]")
    depth = catalogue.depth(table.rules.depth)
    protocol, captures = open_protocol(table, folder, configs)
    draws = selected_draws(table, protocol, options.quick)
    isolated = _isolated_launcher(configs, table, options)
    contents = method_contents(configs, {draw.category for draw in draws}, isolated)
    scenes: list[Scene] = []
    with progress("preparing", len(draws), "draws") as bar:
        for scene in prepare_draws(table, folder, draws, captures, depth):
            scenes.append(scene)
            bar.advance()
    jobs = cell_jobs(table, folder, protocol, configs, contents, scenes)
    left = open_jobs(jobs, folder, console.print)
    still = len(left.to_make) + len(left.to_score)
    console.print(f"{len(jobs)} cells: {len(left.done)} reused, {still} open")
    for column, reason in missing_networks(jobs[0].scoring).items():
        console.print(f"{column} stays empty: {reason}")
    for method, reason in sorted({(job.method.name, _missing_weights(job)) for job in jobs}):
        if reason:
            console.print(f"{method} stays empty: {reason}")
    if options.dry_run:
        print_plan(jobs, left, folder, console)
        return 0
    plan = Plan(
        table=table,
        quick=options.quick,
        protocol=protocol.sha256,
        scored_from=jobs[0].scored_from,
        methods={config.name: config for config in configs},
        cells=[job.folder.name for job in jobs],
        depth_from_files=isinstance(depth, FilesDepthConfig),
    )
    try:
        with _launchers(isolated, options.launcher, len(jobs)) as (making, scoring):
            made = _make(left.to_make, making, folder)
            images = [
                replace(job, unscored_cell=job.folder)
                for job, cell in zip(left.to_make, made, strict=True)
                if cell.images
            ]
            scored = _score([*left.to_score, *images], scoring)
    except KeyboardInterrupt:
        kept = sum((job.folder / "cell.json").is_file() for job in jobs)
        raise KeyboardInterrupt(
            f"{kept} of {len(jobs)} cells are kept in {folder.path}; run the same command again "
            "to go on"
        ) from None
    write_sealed(folder.plan, plan)
    return _report(folder, catalogue, [*made, *scored], console)


def _make(jobs: Sequence[CellJob], making: Making, folder: TableFolder) -> list[Cell]:
    """Let the methods make their images, and keep what is sound; a cell per job, in their order."""
    cells: dict[int, Cell] = {}
    with (
        truths_removed(folder.truths) if jobs else nullcontext(),
        progress("making", len(jobs), "cells") as bar,
    ):
        for index, result in making(jobs):
            job = jobs[index]
            scene = Scene.open(job.scene)
            size = scene.record.image_size
            output = check_output(result, len(scene.draw.targets), size, job.method.name)
            cells[index] = keep_output(job, output)
            reason = f": {cells[index].reason}" if cells[index].status == FAILED else ""
            bar.advance(note=f"{job.method.name} {cells[index].status}{reason}")
    return [cells[index] for index in range(len(jobs))]


def _score(jobs: Sequence[CellJob], launcher: Launcher) -> list[Cell]:
    """Score what is made, and put the cells in their places."""
    cells = []
    with progress("scoring", len(jobs), "cells") as bar:
        for index, result in launcher.run(score_cell, jobs):
            if isinstance(result, Died):
                result = keep_output(jobs[index], failed_output(result.reason))
            cells.append(result)
            bar.advance()
    return cells


def _report(
    folder: TableFolder, catalogue: Catalogue, fresh: Sequence[Cell], console: Console
) -> int:
    """Write the reports and print the numbers; returns how many cells have failed."""
    from benchmarks.report import lay_out_results, numbers, write_reports  # heavy: they draw

    results = read_results(folder)
    layout = lay_out_results(results, catalogue)
    written = write_reports(results, layout, folder)
    console.print(f"\n{numbers(layout, console.width)}\n")
    problems: dict[str, list[str]] = defaultdict(list)
    for cell in fresh:
        if cell.status not in (OK, MADE):
            problems[cell.reason].append(cell.method)
    for reason, names in problems.items():
        console.print(f"{len(names)} cells of {', '.join(sorted(set(names)))}: {reason}")
    for path in written:
        console.print(f"written: {path}")
    console.print(f"result: {folder.path}")
    return sum(cell.status == FAILED for cell in results.cells)


def _isolated_launcher(
    configs: Sequence[MethodConfig], table: TableConfig, options: RunOptions
) -> IsolatedLauncher:
    """What runs the methods' code, each time in a process of its own."""
    ours = {config.factory.rpartition(".")[0] for config in configs if is_ours(config)}
    preload = ("benchmarks.run.run_method", *sorted(ours))
    cores = 1 if device_of(table) == "cuda" else available_cores()
    return IsolatedLauncher(options.workers or cores, table.cell_timeout_s, preload)


@contextmanager
def _launchers(
    isolated: IsolatedLauncher, elsewhere: Launcher | None, cells: int
) -> Iterator[tuple[Making, Launcher]]:
    """What makes images, each cell's in a process of its own, and what scores them."""
    if elsewhere is not None:
        alone = IsolatedJob(run_method, isolated.timeout_s, isolated.preload)
        yield partial(elsewhere.run, alone), elsewhere
        return
    # A further process loads for as long as it takes to score some cells here.
    with LocalLauncher(min(isolated.workers, 1 + cells // _CELLS_PER_SCORER)) as local:
        yield partial(isolated.run, run_method), local


def _missing_weights(job: CellJob) -> str:
    """Why a cell's method has no weights; empty where it has them, or needs none."""
    return job.made_from.inputs["weights"].partition(MISSING_WEIGHTS)[2]


def print_plan(
    jobs: Sequence[CellJob], left: OpenJobs, folder: TableFolder, console: Console
) -> None:
    """What would run, and how long."""
    known = _seconds_of_cells(folder)
    making, scoring = (known.groupby("method")[step].median() for step in ("making", "scoring"))
    shown = Table("method", "cells", "to make", "to score", "seconds a cell")
    total, unknown = 0.0, []
    for name in dict.fromkeys(job.method.name for job in jobs):
        mine, to_make, to_score = (
            [job for job in part if job.method.name == name]
            for part in (jobs, left.to_make, left.to_score)
        )
        make_s, score_s = (float(step.get(name, math.nan)) for step in (making, scoring))
        score_s = float(known["scoring"].median()) if math.isnan(score_s) else score_s
        if (to_make and math.isnan(make_s)) or (to_score and math.isnan(score_s)):
            unknown.append(name)
        per_cell = np.nan_to_num([make_s, score_s])
        total += float(per_cell @ [len(to_make), len(to_make) + len(to_score)])
        rate = "not yet known" if math.isnan(make_s) else f"{per_cell.sum():.1f}"
        shown.add_row(name, *(str(len(part)) for part in (mine, to_make, to_score)), rate)
    console.print(shown)
    duration = timedelta(seconds=round(total))
    said = [f"about {duration} (h:mm:ss) of one core"] if total or not unknown else []
    said += [f"no finished cell tells how long {', '.join(unknown)} will take"] if unknown else []
    console.print("; ".join(said))


def _seconds_of_cells(folder: TableFolder) -> pd.DataFrame:
    """What making and scoring each finished cell took, of any options."""
    rows = []
    for file in folder.cells.glob("*/cell.json"):
        with suppress(InputError):
            cell = read_record(file, Cell, "")
            making = cell.wall_seconds if cell.images else None
            rows.append((cell.method, making, cell.scoring_seconds))
    frame = pd.DataFrame(rows, columns=["method", "making", "scoring"])
    return frame.astype({"making": float, "scoring": float})
