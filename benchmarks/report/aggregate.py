"""A table's results as data frames: every number, the means with intervals, and what captures tell
beyond chance.

A value is a capture's: its draws and seeds are averaged before, for they do not count as samples.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float
from scipy import stats

from benchmarks.protocol.prepared_scene import Scene
from benchmarks.run.cells import OK, Cell, Plan, planned_cells, read_plan
from benchmarks.run.plan import TableFolder
from extrap_train.config import MethodConfig, metric_direction
from extrap_train.errors import InputError

TIDY = [
    "method", "category", "sequence", "n_views", "draw", "seed", "metric", "value", "status",
    "reason",
]  # fmt: skip
MEASURED = ("seconds", "peak_memory_mib")
"""Metrics of the making of the images, not of the images: no scoring has to do with them."""
UNIT = ["category", "sequence", "draw", "seed"]
"""What a paired comparison pairs by."""
CELL = ["method", *UNIT, "n_views"]
"""What names a cell."""
CAPTURE = ["category", "sequence"]
"""What counts as a sample: draws and seeds of one capture do not count."""
_ORACLE = "_oracle"
"""Ends the name of a table with the data set's depth, which is otherwise that of another table."""
MEANS = [
    "method", "draw", "n_views", "metric", "mean", "low", "high", "captures", "cells", "of", "rank",
    "p_best", "behind_best",
]  # fmt: skip


@dataclass(frozen=True)
class Results:
    """The cells of a table as it was last run."""

    folder: TableFolder
    plan: Plan
    cells: list[Cell]

    @property
    def methods(self) -> dict[str, MethodConfig]:
        """By name, in the table's order."""
        return self.plan.methods

    def counterpart(self) -> "Results | None":
        """The results in the folder beside, of the same captures and rules, of which one is the
        oracle table (`NAME_oracle`) and the other has estimated depth; None where there are none.

        Raises InputError where they are damaged.
        """
        name, own = self.plan.table.name, self.plan.table
        other = name.removesuffix(_ORACLE) if name.endswith(_ORACLE) else name + _ORACLE
        folder = TableFolder(self.folder.path.with_name(other))
        if not folder.plan.is_file():
            return None
        found = read_results(folder)
        table = found.plan.table
        same_rules = replace(table.rules, depth=own.rules.depth) == own.rules
        is_pair = table.rules.is_oracle != own.rules.is_oracle
        return found if is_pair and same_rules and table.captures == own.captures else None

    @cached_property
    def tidy(self) -> pd.DataFrame:
        """One row per cell and metric; an empty value has its status and reason."""
        rows = []
        for cell in self.cells:
            head = {name: getattr(cell, name) for name in CELL}
            state = {"status": cell.status, "reason": cell.reason}
            if cell.status != OK:
                rows.append({**head, "metric": "", "value": np.nan, **state})
                continue
            for metric, score in cell.metrics.items():
                reason = {"reason": score.reason}
                rows.append({**head, "metric": metric, "value": score.value, **state, **reason})
            rows += [
                {**head, "metric": name, "value": getattr(cell, name), **state} for name in MEASURED
            ]
        table = pd.DataFrame(rows, columns=TIDY)
        return table.assign(value=table["value"].astype(float))

    @cached_property
    def by_image(self) -> pd.DataFrame:
        """One row per target image and metric, with its angle to the nearest input in degrees."""
        rows = []
        for cell in self.cells:
            if cell.status != OK:
                continue
            scene = Scene.open(self.folder.scenes / cell.scene)
            angles = np.degrees(scene.record.angles_rad)
            head = [getattr(cell, name) for name in CELL]
            for metric, score in cell.metrics.items():
                if len(score.per_image) not in (0, len(angles)):
                    raise InputError(
                        f"{self.folder.cells / cell.key}: has another number of {metric} than of "
                        "targets; run the table again"
                    )
                images = zip(scene.draw.targets, angles, score.per_image, strict=False)
                rows += [(*head, target, angle, metric, value) for target, angle, value in images]
        columns = [*CELL, "target", "angle_deg", "metric", "value"]
        return pd.DataFrame(rows, columns=columns)

    def means(self, category: str | None = None) -> pd.DataFrame:
        """One row per method, draw, number of views and metric: mean over captures with its
        interval, the count of captures, of cells and of those that any method has, rank, the
        paired test against the best (`p_best`), and whether the method is worse beyond chance.

        A method that lacks cells has no rank: its mean is of other captures. Where most methods
        lack some, none has: who is best would be a matter of who is left.
        """
        if category not in self._means:
            self._means[category] = self._compute_means(category)
        return self._means[category]

    @cached_property
    def _means(self) -> dict[str | None, pd.DataFrame]:
        return {}

    def _compute_means(self, category: str | None) -> pd.DataFrame:
        table = self.tidy[self.tidy["metric"] != ""].dropna(subset=["value"])
        if category is not None:
            table = table[table["category"] == category]
        rows: list[dict[str, Any]] = []
        for (draw, n_views, metric), part in table.groupby(["draw", "n_views", "metric"]):
            head = {"draw": draw, "n_views": n_views, "metric": metric}
            rows += _rank_means(
                part, head, metric_direction(str(metric), self.plan.table.scoring.own)
            )
        return pd.DataFrame(rows, columns=MEANS)


def read_results(folder: TableFolder) -> Results:
    """The cells that the last run planned, without those that are missing.

    Raises InputError where no run was, where its plan or a cell is damaged, and where a cell is of
    another protocol.
    """
    if not folder.plan.is_file():
        raise InputError(f"{folder.path}: holds no results; `benchmark run` makes them")
    plan = read_plan(folder.plan)
    return Results(folder, plan, planned_cells(folder.cells, plan))


def _rank_means(part: pd.DataFrame, head: dict[str, Any], sign: int) -> list[dict[str, Any]]:
    """Means of one column, with ranks and paired differences to the best.

    `sign` is 1 where higher is better, -1 where lower is, 0 for no ranks.
    """
    values = part.pivot_table(index=UNIT, columns="method", values="value", sort=False)
    complete = values.notna().all()
    means = by_capture(values).mean()
    competing = means[complete] if sign and complete.mean() >= 0.5 else means[:0]
    ranks = (-sign * competing).rank(method="min").reindex(means.index)
    best = str(ranks.idxmin()) if len(competing) else None
    rows = []
    for method in map(str, values.columns):
        own = by_capture(values[method].dropna()).to_numpy()
        low, high = mean_interval(own)
        row = {"method": method, **head, "mean": own.mean(), "low": low, "high": high}
        row |= {"captures": len(own), "cells": int(values[method].count()), "of": len(values)}
        row |= {"rank": ranks[method], "p_best": np.nan, "behind_best": False}
        if best is not None and method != best:
            row["p_best"], row["behind_best"] = to_best(values, best, method, sign)
        rows.append(row)
    return rows


def by_capture(values: Any) -> Any:
    """Means over the draws and seeds of every capture, of numbers that `UNIT` is the index of."""
    return values.groupby(level=CAPTURE, sort=False).mean()


def to_best(values: pd.DataFrame, best: str, method: str, sign: int) -> tuple[float, bool]:
    """The chance of the paired differences between a method and the best, of the cells that both
    have, and whether the method is worse beyond it; the frame's index is `UNIT`, and `sign` is
    the metric's direction.
    """
    ahead = sign * by_capture((values[best] - values[method]).dropna()).to_numpy()
    p = sign_flip_p(ahead)
    return p, is_significant(p) and bool(ahead.mean() > 0)


CONFIDENCE = 0.95
FEWEST_CAPTURES = 6
"""With fewer the test tells nothing apart: that n signs agree by chance has a probability of
2 / 2^n, above 5 % until n is 6.
"""
_FLIPS = 4999
"""Sign patterns that are drawn where there are more; up to 12 captures all are counted."""


def mean_interval(values: Float[np.ndarray, " n"]) -> tuple[float, float]:
    """Student's t interval of the mean at 95 %; NaN for a single value, of unknown spread."""
    if len(values) < 2:
        return math.nan, math.nan
    half = stats.t.ppf((1 + CONFIDENCE) / 2, len(values) - 1) * stats.sem(values)
    return float(values.mean() - half), float(values.mean() + half)


def sign_flip_p(differences: Float[np.ndarray, " n"]) -> float:
    """p of the two-sided sign-flip test: how often the mean of paired differences would be as far
    from zero if each had the other sign as likely as its own (Fisher 1935); NaN below two.

    It needs no normal distribution. Beyond 12 captures p is of random signs, the same ones at every
    call.
    """
    if len(differences) < 2:
        return math.nan
    found = stats.permutation_test(
        (differences,),
        np.mean,
        permutation_type="samples",
        vectorized=True,
        n_resamples=_FLIPS,
        rng=np.random.default_rng(0),
    )
    return float(found.pvalue)


def is_significant(p: float) -> bool:
    """Whether a p is small enough; that of too few captures never is."""
    return p <= 1 - CONFIDENCE
