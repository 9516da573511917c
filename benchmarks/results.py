"""A table's results as data frames: every number, the means with intervals, paired differences."""

import hashlib
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from benchmarks.cells import OK, read_cell
from benchmarks.plan import TableFolder
from benchmarks.scenes import Scene
from extrap_train.data.json_files import read_json
from extrap_train.errors import InputError

RESAMPLES = 2000
CONFIDENCE = 0.95
TIDY = [
    "method", "category", "sequence", "n_views", "draw", "seed", "metric", "value", "status",
    "reason",
]  # fmt: skip
UNIT = ["category", "sequence", "draw", "seed"]
"""What a paired comparison pairs by."""
HIGHER_IS_BETTER = {
    "psnr", "ssim", "masked_psnr", "masked_ssim", "unseen_psnr", "unseen_ssim", "compat_psnr",
    "compat_ssim", "tsed", "warp_psnr", "completeness", "accuracy_share", "f_score",
}  # fmt: skip
LOWER_IS_BETTER = {"dists", "seconds", "peak_memory_mib", "accuracy_distance"}


def direction(metric: str) -> int:
    """1 where higher is better, -1 where lower is, 0 where neither (a property of the draw)."""
    if metric in HIGHER_IS_BETTER:
        return 1
    return -1 if metric in LOWER_IS_BETTER or metric.startswith("lpips") else 0


@dataclass(frozen=True)
class Results:
    """The cells of a table as it was last run."""

    folder: TableFolder
    plan: dict[str, Any]
    cells: list[dict[str, Any]]

    @property
    def methods(self) -> dict[str, dict[str, str]]:
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
        """A row a method, draw, number of views and metric: mean, interval over captures, count,
        the best's mark, and whether the best is better beyond chance (paired).
        """
        table = self.tidy[self.tidy["metric"] != ""].dropna(subset=["value"])
        if category is not None:
            table = table[table["category"] == category]
        rows: list[dict[str, Any]] = []
        for (draw, n_views, metric), part in table.groupby(["draw", "n_views", "metric"]):
            rows += _ranked(part, {"draw": draw, "n_views": n_views, "metric": metric})
        columns = ["method", "draw", "n_views", "metric", "mean", "low", "high", "cells", "rank"]
        return pd.DataFrame(rows, columns=[*columns, "behind_best"])


def read_results(folder: TableFolder) -> Results:
    """The cells that the last run planned; raises InputError where none was, or where a cell is of
    another protocol. A cell that is missing or damaged counts as failed.
    """
    if not folder.plan.is_file():
        raise InputError(f"{folder.path}: holds no results; `benchmark run` makes them")
    plan = read_json(folder.plan)
    cells = []
    for key in plan["cells"]:
        cell = read_cell(folder.cells / key)
        if cell is None:
            continue
        if cell["hashes"]["protocol"] != plan["protocol"]:
            raise InputError(
                f"{folder.cells / key}: is a result of another protocol "
                f"({cell['hashes']['protocol'][:12]}, the table's is {plan['protocol'][:12]}); "
                "remove it"
            )
        cells.append(cell)
    return Results(folder, plan, cells)


def _ranked(part: pd.DataFrame, head: dict[str, Any]) -> list[dict[str, Any]]:
    """Means of one column, with ranks and paired differences to the best."""
    values = part.pivot_table(index=UNIT, columns="method", values="value", sort=False)
    sign = direction(head["metric"])
    means = values.mean()
    ranks = (-sign * means).rank(method="min") if sign else pd.Series(np.nan, index=means.index)
    best = ranks.idxmin() if sign else None
    rows = []
    for method in values.columns:
        own = values[method].dropna().to_numpy()
        low, high = interval(own, seed_of(str(method), *map(str, head.values())))
        row = {"method": method, **head, "mean": own.mean(), "low": low, "high": high}
        behind = method != best and best is not None and is_behind(values, str(best), str(method))
        rows.append({**row, "cells": len(own), "rank": ranks[method], "behind_best": behind})
    return rows


def is_behind(values: pd.DataFrame, best: str, other: str) -> bool:
    """Whether the paired difference's interval leaves out zero, over the captures that have both.

    A single pair tells nothing.
    """
    both = values[[best, other]].dropna()
    if len(both) < 2:
        return False
    low, high = interval((both[best] - both[other]).to_numpy(), seed_of(best, other))
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
