"""Two result sets of one protocol: what has changed, with intervals."""

import pandas as pd

from benchmarks.plan import TableFolder
from benchmarks.results import UNIT, direction, interval, read_results, seed_of
from extrap_train.errors import InputError


def compare(before: TableFolder, after: TableFolder) -> pd.DataFrame:
    """A row a method, number of views and metric: both means over the cells that both have, the
    paired difference with its 95 % interval, and a verdict.

    Raises InputError where the two are of different protocols.
    """
    one, two = read_results(before), read_results(after)
    if one.plan["protocol"] != two.plan["protocol"]:
        raise InputError(
            f"{before.path} and {after.path} are of different protocols "
            f"({one.plan['protocol'][:12]}, {two.plan['protocol'][:12]}): no number of one can be "
            "set against the other's"
        )
    keys = ["method", *UNIT, "n_views", "metric"]
    both = one.tidy.merge(two.tidy, on=keys, suffixes=("_before", "_after"))
    both = both[both["metric"] != ""].dropna(subset=["value_before", "value_after"])
    rows = []
    for (method, n_views, metric), part in both.groupby(
        ["method", "n_views", "metric"], sort=False
    ):
        difference = (part["value_after"] - part["value_before"]).to_numpy()
        low, high = interval(difference, seed_of(str(method), str(n_views), str(metric)))
        rows.append(
            {
                "method": method,
                "n_views": n_views,
                "metric": metric,
                "before": part["value_before"].mean(),
                "after": part["value_after"].mean(),
                "difference": difference.mean(),
                "low": low,
                "high": high,
                "cells": len(part),
                "verdict": _verdict(low, high, direction(str(metric)), len(part)),
            }
        )
    if not rows:
        raise InputError(f"{before.path} and {after.path} have no finished cell in common")
    return pd.DataFrame(rows)


def _verdict(low: float, high: float, sign: int, cells: int) -> str:
    if low == high == 0:
        return "the same"
    if cells < 2 or low <= 0 <= high or sign == 0:
        return "no difference beyond chance" if sign else ""
    return "better" if (low > 0) == (sign > 0) else "worse"
