"""Two result sets of one protocol: what has changed, with intervals."""

from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from benchmarks.report.aggregate import (
    CELL,
    FEWEST_CAPTURES,
    MEASURED,
    UNIT,
    Results,
    by_capture,
    is_significant,
    mean_interval,
    sign_flip_p,
)
from benchmarks.run.cells import Cell
from benchmarks.run.identity import identity_of
from extrap_train.config import metric_direction
from extrap_train.errors import InputError

_HEADING = ["method", "draw", "n_views", "metric"]


def compare(one: Results, two: Results) -> pd.DataFrame:
    """One row per method, draw, number of views and metric: both means over the cells that both
    have, the paired difference with its 95 % interval over captures, the `chance` of it, a verdict,
    and whether both were scored alike (`same`, or `other`: other weights of the networks, options
    or code, so that a change may be the judges' and not the method's).

    Raises InputError where the two are of different protocols, or of different data.
    """
    if one.plan.protocol != two.plan.protocol:
        raise InputError(
            f"{one.folder.path} and {two.folder.path} are of different protocols "
            f"({one.plan.protocol[:12]}, {two.plan.protocol[:12]}): no number of one can be "
            "set against the other's"
        )
    _require_same_data(one, two)
    both = one.tidy.merge(two.tidy, on=[*CELL, "metric"], suffixes=("_before", "_after"))
    both = both[both["metric"] != ""].dropna(subset=["value_before", "value_after"])
    if both.empty:
        raise InputError(f"{one.folder.path} and {two.folder.path} have no finished cell in common")
    judges = _scorings(one), _scorings(two)
    own = one.plan.table.scoring.own | two.plan.table.scoring.own
    rows = []
    for head, part in both.groupby(_HEADING, sort=False):
        metric = str(head[-1])
        row = {
            **dict(zip(_HEADING, head, strict=True)),
            **_change(part, metric_direction(metric, own)),
        }
        cells = part[CELL].itertuples(index=False, name=None)
        alike = metric in MEASURED or all(judges[0][cell] == judges[1][cell] for cell in cells)
        rows.append({**row, "scoring": "same" if alike else "other"})
    return pd.DataFrame(rows)


def _change(part: pd.DataFrame, sign: int) -> dict[str, Any]:
    means = by_capture(part.set_index(UNIT)[["value_before", "value_after"]])
    difference = (means["value_after"] - means["value_before"]).to_numpy()
    low, high = mean_interval(difference)
    p = sign_flip_p(difference)
    return {
        "before": means["value_before"].mean(),
        "after": means["value_after"].mean(),
        "difference": difference.mean(),
        "low": low,
        "high": high,
        "captures": len(difference),
        "p": p,
        "verdict": _verdict(difference, p, sign),
    }


def _verdict(difference: Float[np.ndarray, " n"], p: float, sign: int) -> str:
    if not difference.any():
        return "the same"
    if sign == 0:
        return ""
    if len(difference) < FEWEST_CAPTURES:
        return "too few captures to tell"
    if not is_significant(p):
        return "no difference beyond chance"
    return "better" if sign * difference.mean() > 0 else "worse"


def _require_same_data(one: Results, two: Results) -> None:
    """A protocol names frames: what they show is another hash."""
    known = {_draw(cell): _photographs(cell, one) for cell in one.cells}
    for cell in two.cells:
        photographs = _photographs(cell, two)
        if known.get(_draw(cell), photographs) != photographs:
            raise InputError(
                f"{one.folder.path} and {two.folder.path} hold different photographs or "
                f"cameras of {cell.scene}: no number of one can be set against the other's"
            )


def _photographs(cell: Cell, results: Results) -> str:
    try:
        return cell.made_from.inputs["photographs"]
    except KeyError:
        raise InputError(
            f"{results.folder.path}: a cell of {cell.method} does not say which photographs it was "
            "made from; run the table again"
        ) from None


def _scorings(results: Results) -> dict[tuple[Any, ...], str]:
    return {(cell.method, *_draw(cell)): identity_of(cell.scored_from) for cell in results.cells}


def _draw(cell: Cell) -> tuple[Any, ...]:
    return tuple(getattr(cell, name) for name in (*UNIT, "n_views"))
