"""Intervals, ranks and paired differences, against what is known of the numbers."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from benchmarks.columns import COLUMNS, direction
from benchmarks.plan import TableFolder
from benchmarks.report.layout import NAMES, Entry, Layout, Panel, Row, lay_out
from benchmarks.report.text import latex, markdown
from benchmarks.results import UNIT, Results, interval, is_behind


def test_the_interval_is_the_means_own_spread() -> None:
    """Against the normal theory of a mean of 400."""
    values = np.random.default_rng(0).normal(5.0, 2.0, 400)
    low, high = interval(values, seed=1)
    half = 1.96 * values.std() / 20
    assert low == pytest.approx(values.mean() - half, abs=0.04)
    assert high == pytest.approx(values.mean() + half, abs=0.04)
    assert interval(values, seed=1) == (low, high)
    assert interval(np.array([3.0]), seed=0) == (3.0, 3.0)


def test_pairing_sees_a_small_difference_among_large_ones() -> None:
    """Captures differ by tens, methods by 0.1: unpaired intervals overlap, paired ones do not."""
    rng = np.random.default_rng(0)
    scenes = rng.normal(20, 10, 24)
    captures = pd.MultiIndex.from_tuples([("cup", i, "random", 0) for i in range(24)], names=UNIT)
    noise = rng.normal(0, 0.02, 24)
    table = pd.DataFrame({"a": scenes, "b": scenes - 0.1 + noise}, index=captures)
    assert interval(table["a"].to_numpy(), 0)[0] < interval(table["b"].to_numpy(), 0)[1]
    assert is_behind(table, "a", "b")
    assert not is_behind(table.assign(b=scenes + rng.normal(0, 1, 24)), "a", "b")
    assert not is_behind(table[:1], "a", "b")


def test_every_metric_has_its_direction() -> None:
    assert direction("lpips_vgg") == direction("dists") == direction("seconds") == -1
    assert direction("masked_psnr") == direction("tsed") == 1
    assert direction("coverage") == direction("warp_psnr_truth") == 0
    assert set(NAMES) - {"lpips"} <= COLUMNS


def _cell(
    method: str, sequence: str, seed: int, psnr: float | None, **given: str
) -> dict[str, Any]:
    failed = {"status": "failed", "reason": "no luck"}
    done = {"status": "ok", "reason": "", "seconds": 1.0, "peak_memory_mib": 9.0, "given": given}
    done["metrics"] = {"psnr": {"value": psnr, "reason": "", "per_image": [psnr]}}
    head = {"method": method, "category": "cup", "sequence": sequence, "draw": "random"}
    return {
        **head,
        "seed": seed,
        "n_views": 3,
        "device": "cpu",
        **(failed if psnr is None else done),
    }


def _results(*cells: dict[str, Any]) -> Results:
    names = dict.fromkeys(cell["method"] for cell in cells)
    table = {"name": "t", "title": "", "columns": ["psnr"]}
    plan = {
        "table": {**table, "rules": {"pool": 9, "image_size": 64, "depth": "dataset"}},
        "protocol": "0" * 64,
        "quick": False,
        "cells": ["key"] * len(cells),
        "methods": {name: {"title": name, "group": "", "time": "in all"} for name in names},
    }
    return Results(TableFolder(Path("nowhere")), plan, list(cells))


def test_seeds_of_one_capture_are_no_further_captures() -> None:
    """Thirty seeds of two captures, of which one is for `a` and one for `b`: nothing is certain."""
    cells = [
        _cell(method, sequence, seed, value)
        for seed in range(30)
        for method, values in {"a": (30.0, 20.0), "b": (20.0, 29.9)}.items()
        for sequence, value in zip("01", values, strict=True)
    ]
    means = _results(*cells).means().query("metric == 'psnr'").set_index("method")
    assert tuple(means.loc["a", ["low", "high"]]) == (20.0, 30.0)  # either capture, twice
    assert list(means["cells"]) == [60, 60]
    one = _results(*(cell for cell in cells if cell["sequence"] == "0")).means()
    assert not one["behind_best"].any(), "a single capture tells nothing, with any number of seeds"


def test_a_mean_over_easier_captures_is_not_the_best() -> None:
    """`partial` has failed on the capture that is hard for all."""
    results = _results(
        *(_cell("whole", sequence, 0, psnr) for sequence, psnr in {"0": 30.0, "1": 20.0}.items()),
        *(_cell("worse", sequence, 0, psnr) for sequence, psnr in {"0": 29.0, "1": 19.0}.items()),
        *(_cell("partial", sequence, 0, psnr) for sequence, psnr in {"0": 28.0, "1": None}.items()),
    )
    means = results.means().query("metric == 'psnr'").set_index("method")
    assert means.loc["whole", "rank"] == 1
    assert means.loc["worse", "rank"] == 2
    assert np.isnan(means.loc["partial", "rank"])
    text = markdown(lay_out(results, None))
    assert "| whole | **25.00** |" in text
    assert "| worse | <u>24.00</u> |" in text
    assert "| partial | 28.00 (1/2) |" in text


def test_what_was_given_is_said_of_every_cell() -> None:
    results = _results(
        _cell("ours", "0", 0, 30.0, depth="used", ended="time"),
        _cell("ours", "1", 0, 30.0, depth="used", ended="steps"),
        _cell("ours", "2", 0, 30.0, depth="used", ended="steps"),
    )
    notes = "\n".join(lay_out(results, None).notes)
    assert "Given: ours — depth: used, ended: steps (2 cells) / time (1 cells)." in notes


def _layout() -> Layout:
    rows = [
        Row("A & B", "one", [Entry("30.00", 30.0, 1), Entry("–", None)]),
        Row("C_1", "two", [Entry("29.00", 29.0, 2, ties_best=True), Entry("0.2", 0.2, 1)]),
    ]
    panel = Panel("Everything, random inputs", [("psnr", 3), ("dists", 3)], rows)
    return Layout("A table", [panel], panel, ["dists: no weights"], ["a note, 95 %"])


def test_markdown_marks_best_second_and_ties() -> None:
    text = markdown(_layout())
    assert "| A & B | **30.00** | – |" in text
    assert "| C_1 | <u>29.00</u>° | **0.2** |" in text
    assert "| method | PSNR ↑ 3 views | DISTS ↓ 3 views |" in text
    assert "- dists: no weights" in text


def test_latex_is_escaped_and_marked() -> None:
    text = latex(_layout())
    assert r"A \& B & \textbf{30.00} & -- \\" in text
    assert r"C\_1 & \underline{29.00}$^\circ$ & \textbf{0.2} \\" in text
    assert text.count(r"\midrule") == 4  # under both heads, and between both groups
    assert text.count("{") == text.count("}")
