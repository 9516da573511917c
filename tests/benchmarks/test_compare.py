"""What is said of a change: only what enough captures bear out, and who judged."""

from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import pytest

from benchmarks.report.compare import compare
from tests.benchmarks.made import cell, results


def _verdict(change: np.ndarray, metric: str = "psnr") -> Any:
    before = results(*(cell("a", str(i), 0, 20.0 + i, {"dists": 0.5}) for i in range(len(change))))
    after = results(
        *(cell("a", str(i), 0, 20.0 + i + c, {"dists": 0.5 + c}) for i, c in enumerate(change))
    )
    return compare(before, after).set_index("metric").loc[metric]


def test_better_and_worse_go_with_the_metrics_direction() -> None:
    gain = np.linspace(0.1, 0.2, 6)
    assert _verdict(gain)["verdict"] == _verdict(-gain, "dists")["verdict"] == "better"
    assert _verdict(-gain)["verdict"] == _verdict(gain, "dists")["verdict"] == "worse"
    assert _verdict(gain)["difference"] == pytest.approx(0.15)
    assert _verdict(gain)["p"] == 2 / 2**6
    assert _verdict(gain * [1, -1, 1, -1, 1, 1])["verdict"] == "no difference beyond chance"
    assert _verdict(0 * gain)["verdict"] == _verdict(gain, "seconds")["verdict"] == "the same"


def test_five_captures_are_too_few_however_alike() -> None:
    assert _verdict(np.full(5, 3.0))["verdict"] == "too few captures to tell"
    single = _verdict(np.full(1, 3.0))
    assert single["verdict"] == "too few captures to tell"
    assert np.isnan(single["low"])


def test_memory_has_no_verdict() -> None:
    before = results(*(cell("a", str(i), 0, 20.0) for i in range(8)))
    after = results(*(replace(cell("a", str(i), 0, 20.0), peak_memory_mib=5.0) for i in range(8)))
    assert set(compare(before, after).query("metric == 'peak_memory_mib'")["verdict"]) == {""}


def test_other_judges_are_noted_row_by_row() -> None:
    """One of two methods was scored with other weights: its scores say so, its time does not."""
    both = [cell(name, str(i), 0, 20.0) for name in ("a", "b") for i in range(6)]
    again = [cell("a", str(i), 0, 20.0, scoring="other judges") for i in range(6)]
    rows = compare(results(*both), results(*again, *both[6:]))
    found = rows.set_index(["method", "metric"])["scoring"]
    expected = {("a", "psnr"): "other", ("a", "seconds"): "same", ("b", "psnr"): "same"}
    pd.testing.assert_series_equal(found[list(expected)], pd.Series(expected), check_names=False)
