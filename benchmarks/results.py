"""A table's results as data frames: every number, the means with intervals, paired differences."""

import hashlib
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from benchmarks.cells import OK
from benchmarks.columns import direction
from benchmarks.plan import TableFolder
from benchmarks.records import planned_cells, read_plan
from benchmarks.scenes import Scene
from extrap_train.errors import InputError

RESAMPLES = 2000
CONFIDENCE = 0.95
TIDY = [
    "method", "category", "sequence", "n_views", "draw", "seed", "metric", "value", "status",
    "reason",
]  # fmt: skip
UNIT = ["category", "sequence", "draw", "seed"]
"""What a paired comparison pairs by."""
CAPTURE = ["category", "sequence"]
"""What is drawn anew in a bootstrap: draws and seeds of one capture are no independent samples."""


@dataclass(frozen=True)
class Results:
    """The cells of a table as it was last run."""

    folder: TableFolder
    plan: dict[str, Any]
    cells: list[dict[str, Any]]

    @property
    def methods(self) -> dict[str, dict[str, Any]]:
        """Title, group and meaning of time by method, in the table's order."""
        return dict(self.plan["methods"])

    @cached_property
    def tidy(self) -> pd.DataFrame:
        """A row a cell and metric; an empty value has its status and reason."""
        rows = []
        for cell in self.cells:
            head = {name: cell[name] for name in ("method", *UNIT, "n_views")}
            state = {"status": cell["status"], "reason": cell["reason"]}
            if cell["status"] != OK:
                rows.append({**head, "metric": "", "value": np.nan, **state})
                continue
            for metric, score in cell["metrics"].items():
                reason = {"reason": score["reason"]}
                rows.append({**head, "metric": metric, "value": score["value"], **state, **reason})
            measured = ("seconds", "peak_memory_mib")
            rows += [{**head, "metric": name, "value": cell[name], **state} for name in measured]
        table = pd.DataFrame(rows, columns=TIDY)
        return table.assign(value=table["value"].astype(float))

    @cached_property
    def by_image(self) -> pd.DataFrame:
        """A row a target image and metric, with its angle to the nearest input in degrees."""
        rows = []
        for cell in self.cells:
            if cell["status"] != OK:
                continue
            scene = Scene.open(self.folder.scenes / cell["scene"])
            angles = np.degrees(scene.angles_rad)
            for metric, score in cell["metrics"].items():
                for index, value in enumerate(score["per_image"]):
                    rows.append(
                        {
                            **{name: cell[name] for name in ("method", *UNIT, "n_views")},
                            "target": scene.draw.targets[index],
                            "angle_deg": angles[index],
                            "metric": metric,
                            "value": value,
                        }
                    )
        columns = ["method", *UNIT, "n_views", "target", "angle_deg", "metric", "value"]
        return pd.DataFrame(rows, columns=columns)

    def means(self, category: str | None = None) -> pd.DataFrame:
        """A row a method, draw, number of views and metric: mean, interval over captures, the count
        of cells and of those that any method has, rank, and whether the best is better beyond
        chance (paired). A method that lacks cells has no rank: its mean is of other captures.
        """
        table = self.tidy[self.tidy["metric"] != ""].dropna(subset=["value"])
        if category is not None:
            table = table[table["category"] == category]
        rows: list[dict[str, Any]] = []
        for (draw, n_views, metric), part in table.groupby(["draw", "n_views", "metric"]):
            rows += _ranked(part, {"draw": draw, "n_views": n_views, "metric": metric})
        columns = ["method", "draw", "n_views", "metric", "mean", "low", "high", "cells", "of"]
        return pd.DataFrame(rows, columns=[*columns, "rank", "behind_best"])


def read_results(folder: TableFolder) -> Results:
    """The cells that the last run planned, without those that are missing.

    Raises InputError where no run was, where its plan or a cell is damaged, and where a cell is of
    another protocol.
    """
    if not folder.plan.is_file():
        raise InputError(f"{folder.path}: holds no results; `benchmark run` makes them")
    plan = read_plan(folder.plan)
    return Results(folder, plan, planned_cells(folder.cells, plan))


def _ranked(part: pd.DataFrame, head: dict[str, Any]) -> list[dict[str, Any]]:
    """Means of one column, with ranks and paired differences to the best."""
    values = part.pivot_table(index=UNIT, columns="method", values="value", sort=False)
    sign = direction(head["metric"])
    means = by_capture(values).mean()
    complete = values.notna().all()
    ranks = (-sign * means[complete]).rank(method="min").reindex(means.index)
    best = ranks.idxmin() if sign and complete.any() else None
    rows = []
    for method in values.columns:
        own = by_capture(values[method].dropna()).to_numpy()
        low, high = interval(own, seed_of(str(method), *map(str, head.values())))
        row = {"method": method, **head, "mean": own.mean(), "low": low, "high": high}
        counts = {"cells": int(values[method].count()), "of": len(values)}
        behind = method != best and best is not None and is_behind(values, str(best), str(method))
        rank = ranks[method] if sign else np.nan
        rows.append({**row, **counts, "rank": rank, "behind_best": behind})
    return rows


def by_capture(values: Any) -> Any:
    """Means over the draws and seeds of every capture, of numbers that `UNIT` is the index of."""
    return values.groupby(level=CAPTURE, sort=False).mean()


def is_behind(values: pd.DataFrame, best: str, other: str) -> bool:
    """Whether the interval of the paired difference over captures leaves out zero, of the cells
    that both have; the frame's index is `UNIT`.

    A single capture tells nothing.
    """
    both = values[[best, other]].dropna()
    difference = by_capture(both[best] - both[other]).to_numpy()
    if len(difference) < 2:
        return False
    low, high = interval(difference, seed_of(best, other))
    return bool(low > 0 or high < 0)


def interval(values: Float[np.ndarray, " n"], seed: int) -> tuple[float, float]:
    """Percentile bootstrap of the mean at 95 %: the mean itself for a single value."""
    rng = np.random.default_rng(seed)
    drawn = rng.integers(len(values), size=(RESAMPLES, len(values)))
    tail = (1 - CONFIDENCE) / 2
    low, high = np.quantile(values[drawn].mean(1), [tail, 1 - tail])
    return float(low), float(high)


def seed_of(*names: str) -> int:
    """The same for the same names, whatever else is in the table."""
    return int.from_bytes(hashlib.sha256("/".join(names).encode()).digest()[:8], "big")
