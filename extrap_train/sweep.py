"""What `-m` leaves behind: `sweep.csv`, one row per job, and the same as a picture; of jobs that
differ in `seed` alone the means, in `seeds.md`.

A Hydra callback (`hydra.callbacks` in conf/train.yaml). The table is written after every job, so
that a sweep that is killed has the rows of what it finished, and a job that fails is a row like
another: Hydra goes on with the others and ends with that job's error. A folder holds one sweep.
"""

import math
import sys
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pandas as pd
from filelock import FileLock
from hydra.core.utils import JobReturn, JobStatus
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig

from extrap_train.data.json_files import read_json
from extrap_train.errors import InputError, did_you_mean
from extrap_train.store import Outcome
from extrap_train.store.atomic import file_lock, remove_leftovers, write_atomic
from extrap_train.store.manifest import MANIFEST, Manifest, require_same
from extrap_train.store.records import write_record

JobRow = dict[str, str]
METRIC = "result."
"""Prefix of the metrics' columns, which keeps them apart from options of the same name."""
_TABLE = "sweep.csv"
_ONLY = "every job"
"""Label of jobs that differ in nothing but their seed."""
_HEAD, _TAIL = ("job", "status", "seconds"), ("folder", "reason")
_NO_OPTIONS = (*_HEAD, *_TAIL)
OK, REUSED, FAILED = "ok", "reused", "failed"
_DONE = (OK, REUSED)
_NO_METRICS = ("provenance", "seconds", "asked")
"""Parts of a summary that are not measured of its result."""
_PANELS = 4
_SHOWN = ("psnr", "psnr_holes", "ssim", "lpips")
"""Metrics that are drawn first, by the end of their names."""


class SweepTable(Callback):
    """Writes a row when a job of a sweep has ended, however it ended.

    `objective` names the metric that a sweeper which looks for the best is told as the job's value.
    """

    def __init__(self, objective: str | None = None) -> None:
        self.objective = objective

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        """Hold the sweep's folder for this command alone; end it where another sweep lies there."""
        folder = Path(config.hydra.sweep.dir)
        taken = (
            f"{folder}: another sweep is writing here; wait for it or give another hydra.sweep.dir"
        )
        with _ended_in_one_line(folder):
            folder.mkdir(parents=True, exist_ok=True)
            self._held = ExitStack()
            self._held.enter_context(file_lock(folder / ".sweep.lock", taken))
            remove_leftovers(folder)
            manifest = Manifest.of(_options(config.hydra.overrides.task))
            if (folder / MANIFEST).exists() or (folder / _TABLE).exists():
                require_same(folder, manifest, "give another hydra.sweep.dir")
            else:
                write_record(folder / MANIFEST, manifest)
            read_rows(folder / _TABLE)  # before any job runs, which could not add its row

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        """Hydra's hook."""
        self._held.close()

    def on_job_start(self, config: DictConfig, **_: Any) -> None:
        """Hydra's hook."""
        self._started = time.perf_counter()

    def on_job_end(self, config: DictConfig, job_return: JobReturn, **_: Any) -> None:
        """Hydra's hook; a single run has no table."""
        if config.hydra.mode != RunMode.MULTIRUN:
            return
        seconds = time.perf_counter() - self._started
        folder = Path(config.hydra.sweep.dir)
        with _ended_in_one_line(folder):
            row = row_of(int(config.hydra.job.num), seconds, job_return)
            if self.objective is not None and job_return.status is JobStatus.COMPLETED:
                _give_objective(job_return, row, self.objective)
            rows = add_row(folder / _TABLE, row)
            draw(rows, folder / "sweep.png")
            compare_over_seeds(rows, folder / "seeds.md")
        metrics = _shown_metrics(pd.DataFrame([row]))
        numbers = [f"{_metric_name(name)} {float(row[name]):.4g}" for name in metrics]
        said = ", ".join(numbers) or row["reason"]
        print(f"job {row['job']}: {row['status']} {said}".rstrip())
        print(f"sweep: {folder / _TABLE}", flush=True)


@contextmanager
def _ended_in_one_line(folder: Path) -> Iterator[None]:
    """Hydra makes a warning of what a callback raises, and goes on without a table."""
    try:
        yield
    except InputError as error:
        sys.exit(f"error: {error}")
    except OSError as error:
        place = error.filename or folder
        sys.exit(f"error: {place}: {error.strerror}; give another hydra.sweep.dir")


def row_of(number: int, seconds: float, job: JobReturn) -> JobRow:
    """Number, status, time, overrides, final metrics, and why it failed if it did.

    The metrics are those of `summary.json` in the folder that the task returned.
    """
    # Asked for in public, the value of a job that failed is raised and printed.
    value = job._return_value
    outcome = value if isinstance(value, Outcome) else None
    folder = outcome.folder if outcome else value if isinstance(value, Path) else None
    failed = job.status is not JobStatus.COMPLETED
    reason = f"{type(value).__name__}: {' '.join(str(value).split())}" if failed else ""
    return {
        "job": str(number),
        "status": FAILED if failed else REUSED if outcome and outcome.is_reused else OK,
        "seconds": f"{seconds:.1f}",
        **_options(job.overrides or ()),
        **{METRIC + name: repr(x) for name, x in (metrics_at(folder) if folder else {}).items()},
        "folder": str(folder or ""),
        "reason": reason,
    }


def _options(overrides: Iterable[str]) -> dict[str, str]:
    """Options by name, without `output`: a sweep goes on where its folder was moved to."""
    options = dict(word.lstrip("+~").partition("=")[::2] for word in overrides)
    return {name: value for name, value in options.items() if name != "output"}


def _give_objective(job: JobReturn, row: JobRow, objective: str) -> None:
    """Make the metric the job's value instead of the folder; a job that lacks it has failed."""
    found = row.get(METRIC + objective)
    if found is not None:
        job.return_value = float(found)
        return
    known = [_metric_name(name) for name in row if name.startswith(METRIC)]
    job.status = JobStatus.FAILED
    error = InputError(
        f"hydra.callbacks.sweep_table.objective={objective}: the job has no such metric; "
        f"{did_you_mean(objective, known)}"
    )
    job.return_value = error
    row |= {"status": FAILED, "reason": f"{type(error).__name__}: {error}"}


def metrics_at(folder: Path) -> dict[str, float]:
    """Every number of a result's summary by its dotted name; what could not be had is left out."""
    file = folder / "summary.json"
    if not file.is_file():
        return {}
    summary = read_json(file)
    return dict(_numbers({k: v for k, v in summary.items() if k not in _NO_METRICS}))


def _numbers(tree: Mapping[str, Any], prefix: str = "") -> list[tuple[str, float]]:
    found: list[tuple[str, float]] = []
    for name, value in tree.items():
        if isinstance(value, Mapping):
            found += _numbers(value, f"{prefix}{name}.")
        elif isinstance(value, int | float) and not isinstance(value, bool):
            found.append((prefix + name, float(value)))
    return found


def add_row(file: Path, row: JobRow) -> pd.DataFrame:
    """All rows as texts, sorted by job number, with the new one among them; written at once.

    Columns are those of any row: an empty cell means that the job did not have it.
    """
    file.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(file.with_suffix(".lock")):  # a launcher may run jobs side by side
        rows = read_rows(file)
        rows = pd.concat([rows[rows["job"] != row["job"]], pd.DataFrame([row])]).fillna("")
        rows = rows.sort_values("job", key=lambda job: job.astype(int), ignore_index=True)
        between = [name for name in rows if name not in _NO_OPTIONS]
        rows = rows[[*_HEAD, *between, *_TAIL]]
        write_atomic(file, rows.to_csv(index=False).encode())
    return rows


def read_rows(file: Path) -> pd.DataFrame:
    """The rows that are there, as texts; InputError where the file is no longer such a table."""
    if not file.is_file():
        return pd.DataFrame(columns=[*_HEAD, *_TAIL], dtype=str)
    try:
        rows = pd.read_csv(file, dtype=str, keep_default_na=False, encoding="utf-8-sig")
        if not isinstance(rows.index, pd.RangeIndex):
            raise ValueError("its rows are longer than its head")
        if missing := {*_NO_OPTIONS} - {*rows}:
            raise ValueError(f"it has no column {min(missing)}")
        if not rows["job"].str.fullmatch("[0-9]{1,9}").all():
            raise ValueError("a job is not a number")
        rows.filter(like=METRIC).replace("", None).apply(pd.to_numeric)
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise InputError(
            f"{file}: is not the table that a sweep wrote ({reason}); move it away or give another "
            "hydra.sweep.dir"
        ) from None
    return rows


def draw(rows: pd.DataFrame, file: Path) -> None:
    """One panel per metric with a bar per finished job, named by the overrides that differ."""
    done = rows[rows["status"].isin(_DONE)]
    metrics = _shown_metrics(done)
    if not metrics:
        return
    from matplotlib.figure import Figure  # a second that a single run need not wait

    from extrap_train.figures import save_figure

    labels = _labels(done).where(lambda label: label != "", "job " + done["job"])
    figure = Figure(
        figsize=(7, 0.6 + len(metrics) * (0.5 + 0.25 * len(done))), layout="constrained"
    )
    for axes, metric in zip(
        figure.subplots(len(metrics), squeeze=False)[:, 0], metrics, strict=True
    ):
        axes.barh(range(len(done)), pd.to_numeric(done[metric]), height=0.6)
        axes.set_yticks(range(len(done)), labels, fontsize=8)
        axes.invert_yaxis()
        axes.set_title(metric, fontsize=9)
        axes.bar_label(axes.containers[0], fmt="%.3g", fontsize=8)
    save_figure(figure, file, dpi=120)


def compare_over_seeds(rows: pd.DataFrame, file: Path) -> None:
    """The table of `over_seeds`, once a combination of overrides has run with two seeds.

    The first job's is what the others are compared with, also where it has failed.
    """
    if "seed" not in rows:
        return
    labels = _labels(rows.drop(columns="seed")).replace("", _ONLY)
    done = rows["status"].isin(_DONE) & (rows["seed"] != "")
    metrics = _shown_metrics(rows[done])
    if labels[done].is_unique or not metrics:
        return
    table = rows.loc[done, metrics].apply(pd.to_numeric).rename(columns=_metric_name)
    table.index = pd.MultiIndex.from_arrays([labels[done], rows.loc[done, "seed"]])
    write_atomic(file, over_seeds(labels.iloc[0], table).encode())


def over_seeds(first: str, table: pd.DataFrame) -> str:
    """A Markdown table with one row per label, of jobs indexed by their label and seed.

    Differences are taken seed by seed to the jobs labelled `first`, so that what a seed does to all
    alike drops out, and there are none where these are missing; ± is the standard error of the mean
    over seeds, absent where there is but one.
    """
    table = table[~table.index.duplicated(keep="last")]
    by_label = {first: table[:0].droplevel(0)}
    by_label |= {
        str(label): jobs.droplevel(0) for label, jobs in table.groupby(level=0, sort=False)
    }
    lines = [["", "seeds"], ["---"] * (2 + 2 * len(table.columns))]
    for metric in table:
        lines[0] += [str(metric), "difference"]
    for label, jobs in by_label.items():
        line, apart = [label, str(len(jobs))], jobs - by_label[first]
        for metric in table:
            form = f".{_decimals(table[metric])}f"
            line.append(_spread(jobs[metric], form))
            line.append("" if label == first else _spread(apart[metric], form, sign="+"))
        lines.append(line)
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def _spread(values: "pd.Series[float]", form: str, sign: str = "") -> str:
    known = values.dropna()
    if known.empty:
        return "–"
    mean = format(known.mean(), f"{sign}{form}")
    return mean if len(known) == 1 else f"{mean} ± {format(known.sem(), form)}"


def _decimals(values: "pd.Series[float]") -> int:
    """So many that the column's greatest value has four digits."""
    greatest = values.abs().max()
    return 3 if not greatest > 0 else max(0, 3 - math.floor(math.log10(greatest)))


def _metric_name(column: str) -> str:
    return column.removeprefix(METRIC)


def _shown_metrics(rows: pd.DataFrame) -> list[str]:
    """The model's own first, then whatever else the jobs measured."""
    names = [name for name in map(str, rows) if name.startswith(METRIC) and any(rows[name] != "")]
    rank = {f"{METRIC}validation.model.{name}": at for at, name in enumerate(_SHOWN)}
    return sorted(names, key=lambda name: rank.get(name, len(rank)))[:_PANELS]


def _labels(rows: pd.DataFrame) -> "pd.Series[str]":
    """For every row, the overrides that tell the jobs apart."""
    options = [n for n in map(str, rows) if n not in _NO_OPTIONS and not n.startswith(METRIC)]
    apart = [name for name in options if rows[name].nunique() > 1]
    texts = [
        " ".join(f"{name}={value}" for name, value in zip(apart, row, strict=True) if value)
        for row in rows[apart].itertuples(index=False, name=None)
    ]
    return pd.Series(texts, index=rows.index, dtype=str)
