"""What `-m` leaves behind: `sweep.csv`, a row a job, and the same as a picture; of jobs that differ
in `seed` alone the means, in `seeds.md`.

A Hydra callback (`hydra.callbacks` in conf/train.yaml). The table is written after every job, so
that a sweep that is killed has the rows of what it finished, and a job that fails is a row like
another: Hydra goes on with the others and ends with that job's error.
"""

import csv
import io
import json
import math
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from filelock import FileLock
from hydra.core.utils import JobReturn, JobStatus
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig

from extrap_train.errors import InputError, did_you_mean
from extrap_train.store.atomic import write_atomic
from extrap_train.sweep_seeds import over_seeds

Row = dict[str, str]
METRIC = "result."
_ONLY = "every job"
"""Before the names of metrics, which could be those of options."""
_HEAD, _LAST = ("job", "status", "seconds"), "reason"
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

    def on_job_start(self, config: DictConfig, **_: Any) -> None:
        """Hydra's hook."""
        self._started = time.perf_counter()

    def on_job_end(self, config: DictConfig, job_return: JobReturn, **_: Any) -> None:
        """Hydra's hook; a single run has no table."""
        if config.hydra.mode != RunMode.MULTIRUN:
            return
        seconds = time.perf_counter() - self._started
        number = int(config.hydra.job.num)
        row = row_of(number, seconds, job_return)
        if self.objective is not None and job_return.status is JobStatus.COMPLETED:
            _give_objective(job_return, row, self.objective)
            row |= {"status": _status(job_return), _LAST: _reason(job_return)}
        folder = Path(config.hydra.sweep.dir)
        rows = add_row(folder / "sweep.csv", row)
        draw(rows, folder / "sweep.png")
        compare_over_seeds(rows, folder / "seeds.md")
        print(f"job {row['job']}: {row['status']} {row[_LAST]}".rstrip())
        print(f"sweep: {folder / 'sweep.csv'}", flush=True)


def row_of(number: int, seconds: float, job: JobReturn) -> Row:
    """Number, status, time, overrides, final metrics, and why it failed if it did.

    The metrics are those of `summary.json` in the folder that the task returned.
    """
    value = job._return_value
    overrides = dict(word.lstrip("+~").partition("=")[::2] for word in job.overrides or ())
    metrics = metrics_at(value) if isinstance(value, Path) else {}
    return {
        "job": str(number),
        "status": _status(job),
        "seconds": f"{seconds:.1f}",
        **overrides,
        **{METRIC + name: repr(number) for name, number in metrics.items()},
        _LAST: _reason(job),
    }


def _status(job: JobReturn) -> str:
    return "ok" if job.status is JobStatus.COMPLETED else "failed"


def _reason(job: JobReturn) -> str:
    # Asked for in public, the value of a job that failed is raised and printed.
    error = job._return_value
    if job.status is JobStatus.COMPLETED:
        return ""
    return f"{type(error).__name__}: {' '.join(str(error).split())}"


def _give_objective(job: JobReturn, row: Row, objective: str) -> None:
    """The metric in place of the folder; a job that lacks it has failed."""
    found = row.get(METRIC + objective)
    if found is not None:
        job.return_value = float(found)
        return
    known = [name.removeprefix(METRIC) for name in row if name.startswith(METRIC)]
    job.status = JobStatus.FAILED
    job.return_value = InputError(
        f"hydra.callbacks.sweep_table.objective={objective}: the job has no such metric; "
        f"{did_you_mean(objective, known)}"
    )


def metrics_at(folder: Path) -> dict[str, float]:
    """Every number of a result's summary by its dotted name; what could not be had is left out."""
    file = folder / "summary.json"
    if not file.is_file():
        return {}
    summary = json.loads(file.read_text())
    return dict(_numbers({k: v for k, v in summary.items() if k not in _NO_METRICS}))


def _numbers(tree: Mapping[str, Any], prefix: str = "") -> list[tuple[str, float]]:
    found: list[tuple[str, float]] = []
    for name, value in tree.items():
        if isinstance(value, Mapping):
            found += _numbers(value, f"{prefix}{name}.")
        elif isinstance(value, int | float) and not isinstance(value, bool):
            found.append((prefix + name, float(value)))
    return found


def add_row(file: Path, row: Row) -> list[Row]:
    """All rows by their job's number, the new one among them, written at once.

    Columns are those of any row: an empty one says that this job did not have it.
    """
    file.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(file.with_suffix(".lock")):  # a launcher may run jobs side by side
        rows = [r for r in read_rows(file) if r["job"] != row["job"]]
        rows = sorted([*rows, row], key=lambda r: int(r["job"]))
        names = [name for r in rows for name in r if name not in (*_HEAD, _LAST)]
        text = io.StringIO()
        table = csv.DictWriter(text, [*_HEAD, *dict.fromkeys(names), _LAST], restval="")
        table.writeheader()
        table.writerows(rows)
        write_atomic(file, text.getvalue().encode())
    return rows


def read_rows(file: Path) -> list[Row]:
    """The rows that are there, without their empty columns."""
    if not file.is_file():
        return []
    with file.open(newline="") as content:
        return [
            {k: v for k, v in row.items() if v or k in (*_HEAD, _LAST)}
            for row in csv.DictReader(content)
        ]


def draw(rows: list[Row], file: Path) -> None:
    """A panel a metric, a bar a finished job, named by the overrides that differ."""
    done = [row for row in rows if row["status"] == "ok"]
    metrics = _shown_metrics(done)
    if not metrics:
        return
    from matplotlib.figure import Figure  # a second that a single run need not wait

    labels = [_label(row, done) or f"job {row['job']}" for row in done]
    figure = Figure(
        figsize=(7, 0.6 + len(metrics) * (0.5 + 0.25 * len(done))), layout="constrained"
    )
    for axes, metric in zip(
        figure.subplots(len(metrics), squeeze=False)[:, 0], metrics, strict=True
    ):
        values = [float(row.get(metric, math.nan)) for row in done]
        axes.barh(range(len(done)), values, height=0.6)
        axes.set_yticks(range(len(done)), labels, fontsize=8)
        axes.invert_yaxis()
        axes.set_title(metric, fontsize=9)
        axes.bar_label(axes.containers[0], fmt="%.3g", fontsize=8)
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=120)
    write_atomic(file, content.getvalue())


def compare_over_seeds(rows: list[Row], file: Path) -> None:
    """The table of `over_seeds`, once a combination of overrides has run with two seeds.

    The first job's is what the others are compared with, also where it has failed.
    """
    rows = [row for row in rows if "seed" in row]
    if not rows:
        return
    done = [row for row in rows if row["status"] == "ok"]
    metrics = _shown_metrics(done)
    alike = [{**row, "seed": ""} for row in rows]
    first = _label(alike[0], alike) or _ONLY
    labels = [_label(row, alike) or _ONLY for row in alike if row["status"] == "ok"]
    if len(set(labels)) == len(labels) or not metrics:
        return
    columns = {
        m.removeprefix(METRIC): [float(row.get(m, math.nan)) for row in done] for m in metrics
    }
    write_atomic(file, over_seeds(first, labels, [row["seed"] for row in done], columns).encode())


def _shown_metrics(rows: list[Row]) -> list[str]:
    """The model's own first, then whatever else the jobs measured."""
    names = dict.fromkeys(name for row in rows for name in row if name.startswith(METRIC))
    rank = {f"{METRIC}validation.model.{name}": at for at, name in enumerate(_SHOWN)}
    return sorted(names, key=lambda name: rank.get(name, len(rank)))[:_PANELS]


def _label(row: Row, rows: list[Row]) -> str:
    """The overrides that tell the jobs apart."""
    options = [n for n in row if n not in (*_HEAD, _LAST) and not n.startswith(METRIC)]
    apart = [n for n in options if len({r.get(n) for r in rows}) > 1]
    return " ".join(f"{name}={row.get(name, '')}" for name in apart)
