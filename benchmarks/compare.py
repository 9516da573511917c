"""Two result sets of one protocol: what has changed, with intervals."""

from typing import Any

import pandas as pd

from benchmarks.columns import direction
from benchmarks.plan import TableFolder
from benchmarks.results import UNIT, Results, by_capture, interval, read_results, seed_of
from extrap_train.errors import InputError


def compare(before: TableFolder, after: TableFolder) -> pd.DataFrame:
    """A row a method, draw, number of views and metric: both means over the cells that both have,
    the paired difference with its 95 % interval over captures, and a verdict.

    Raises InputError where the two are of different protocols, or of different data.
    """
    one, two = read_results(before), read_results(after)
    if one.plan["protocol"] != two.plan["protocol"]:
        raise InputError(
            f"{before.path} and {after.path} are of different protocols "
            f"({one.plan['protocol'][:12]}, {two.plan['protocol'][:12]}): no number of one can be "
            "set against the other's"
        )
    _require_same_data(one, two)
    keys = ["method", *UNIT, "n_views", "metric"]
    both = one.tidy.merge(two.tidy, on=keys, suffixes=("_before", "_after"))
    both = both[both["metric"] != ""].dropna(subset=["value_before", "value_after"])
    rows = []
    heading = ["method", "draw", "n_views", "metric"]
    for head, part in both.groupby(heading, sort=False):
        cells = part.set_index(UNIT)
        means = by_capture(cells[["value_before", "value_after"]])
        difference = (means["value_after"] - means["value_before"]).to_numpy()
        low, high = interval(difference, seed_of(*map(str, head)))
        rows.append(
            {
                **dict(zip(heading, head, strict=True)),
                "before": means["value_before"].mean(),
                "after": means["value_after"].mean(),
                "difference": difference.mean(),
                "low": low,
                "high": high,
                "captures": len(means),
                "verdict": _verdict(low, high, direction(str(head[-1])), len(means)),
            }
        )
    if not rows:
        raise InputError(f"{before.path} and {after.path} have no finished cell in common")
    return pd.DataFrame(rows)


def _require_same_data(before: Results, after: Results) -> None:
    """A protocol names frames: what they show is another hash."""
    known = {_task(cell): cell["hashes"]["data"] for cell in before.cells}
    for cell in after.cells:
        if known.get(_task(cell), cell["hashes"]["data"]) != cell["hashes"]["data"]:
            raise InputError(
                f"{before.folder.path} and {after.folder.path} hold different photographs or "
                f"cameras of {cell['scene']}: no number of one can be set against the other's"
            )


def _task(cell: dict[str, Any]) -> tuple[Any, ...]:
    return tuple(cell[name] for name in (*UNIT, "n_views"))


def _verdict(low: float, high: float, sign: int, captures: int) -> str:
    if low == high == 0:
        return "the same"
    if captures < 2 or low <= 0 <= high or sign == 0:
        return "no difference beyond chance" if sign else ""
    return "better" if (low > 0) == (sign > 0) else "worse"
