"""What is said of a change: only what enough captures confirm, and who judged."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from benchmarks.__main__ import main
from benchmarks.report.aggregate import Results, read_results
from benchmarks.report.compare import compare
from extrap_train.errors import InputError
from tests.benchmarks.made import cell, results
from tests.benchmarks.tables import greys_folder, run_greys


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


def test_compare_pairs_cells() -> None:
    one = [cell("dark", "a", 0, 20.0), cell("dark", "b", 0, 22.0), cell("light", "a", 0, 18.0)]
    other = [cell("dark", "b", 0, 25.0), cell("light", "a", 0, 18.0), cell("dark", "a", 0, 21.0)]
    rows = compare(results(*one), results(*other)).set_index(["method", "metric"])
    row = rows.loc[("dark", "psnr")]
    assert row["verdict"] == "too few captures to tell"
    assert row["captures"] == 2
    assert (row["before"], row["after"], row["difference"]) == pytest.approx((21, 23, 2))
    assert rows.loc[("light", "psnr")]["verdict"] == "the same"
    assert (rows["scoring"] == "same").all()


def test_compare_keeps_draws_apart() -> None:
    cells = [replace(cell("a", "x", 0, 20.0), draw=draw) for draw in ("random", "spread")]
    rows = compare(results(*cells), results(*cells)).query("metric == 'psnr'")
    assert list(rows["draw"]) == ["random", "spread"]
    assert list(rows["captures"]) == [1, 1]


def test_compare_refuses_other_photographs() -> None:
    one = cell("a", "x", 0, 20.0)
    other = replace(one, made_from=replace(one.made_from, inputs={"photographs": "of others"}))
    with pytest.raises(InputError, match=r"different photographs or cameras of cup-x-3-random"):
        compare(results(one), results(other))


def _results(output: Path) -> Results:
    return read_results(greys_folder(output))


def test_compare_notes_another_scoring(
    own: Path, finished: Path, copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run_greys(own, copy, "scoring.lpips=[squeeze]")
    rows = compare(_results(finished), _results(copy)).set_index("metric")
    assert set(rows.loc["psnr", "scoring"]) == {"other"}
    assert set(rows.loc["seconds", "scoring"]) == {"same"}
    capsys.readouterr()
    assert main(["compare", str(finished / "greys"), str(copy / "greys")]) == 0
    assert "note: where scoring is `other`" in capsys.readouterr().err
    assert main(["compare", str(copy / "greys"), str(copy / "greys")]) == 0
    assert not capsys.readouterr().err


def test_compare_refuses_a_cell_that_does_not_say_what_it_was_made_from(copy: Path) -> None:
    record = next(copy.glob("greys/cells/*/cell.json"))
    content = json.loads(record.read_text())
    del content["made_from"]["inputs"]["photographs"]
    record.write_text(json.dumps(content))
    with pytest.raises(InputError, match="photographs"):
        compare(_results(copy), _results(copy))
