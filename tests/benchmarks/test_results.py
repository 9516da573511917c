"""Intervals, ranks and paired differences, against what is known of the numbers."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from benchmarks.report.aggregate import UNIT, mean_interval, to_best
from benchmarks.report.formats import latex, markdown
from benchmarks.report.table_layout import NAMES, Entry, Inputs, Layout, Panel, Row, lay_out
from extrap_train.config import METRICS, metric_direction
from tests.benchmarks.made import cell, results


def test_pairing_sees_a_small_difference_among_large_ones() -> None:
    """Captures differ by tens, methods by 0.1: unpaired intervals overlap, paired ones do not."""
    rng = np.random.default_rng(0)
    scenes = rng.normal(20, 10, 24)
    captures = pd.MultiIndex.from_tuples([("cup", i, "random", 0) for i in range(24)], names=UNIT)
    noise = rng.normal(0, 0.02, 24)
    table = pd.DataFrame({"a": scenes, "b": scenes - 0.1 + noise}, index=captures)
    assert mean_interval(table["a"].to_numpy())[0] < mean_interval(table["b"].to_numpy())[1]
    assert to_best(table, "a", "b", sign=1)[1]
    assert not to_best(table.assign(b=scenes + rng.normal(0, 1, 24)), "a", "b", sign=1)[1]
    assert to_best(table[:6], "a", "b", sign=1) == (2 / 2**6, True)
    assert not to_best(table[:5], "a", "b", sign=1)[1]
    assert not to_best(table[:1], "a", "b", sign=1)[1]


def test_every_metric_has_its_direction() -> None:
    assert (
        metric_direction("lpips_vgg")
        == metric_direction("dists")
        == metric_direction("seconds")
        == -1
    )
    assert metric_direction("masked_psnr") == metric_direction("tsed") == 1
    assert metric_direction("coverage") == metric_direction("warp_psnr_truth") == 0
    assert metric_direction("peak_memory_mib") == metric_direction("accuracy_distance") == 0
    assert set(NAMES) - {"lpips"} <= set(METRICS)


def test_seeds_of_one_capture_are_no_further_captures() -> None:
    """Thirty seeds of two captures, of which one is for `a` and one for `b`: nothing is certain."""
    cells = [
        cell(method, sequence, seed, value)
        for seed in range(30)
        for method, values in {"a": (30.0, 20.0), "b": (20.0, 29.9)}.items()
        for sequence, value in zip("01", values, strict=True)
    ]
    means = results(*cells).means().query("metric == 'psnr'").set_index("method")
    half = 12.706 * 5.0  # Student's t of one degree of freedom, and the standard error of 20 and 30
    assert tuple(means.loc["a", ["low", "high"]]) == pytest.approx((25 - half, 25 + half), rel=1e-4)
    assert list(means["cells"]) == [60, 60]
    assert list(means["captures"]) == [2, 2]
    one = results(*(one for one in cells if one.sequence == "0")).means()
    assert not one["behind_best"].any(), "a single capture tells nothing, with any number of seeds"
    assert one[["low", "high"]].isna().all(axis=None)


def test_a_mean_over_easier_captures_is_not_the_best() -> None:
    """`partial` has failed on the capture that is hard for all."""
    table = results(
        *(cell("whole", sequence, 0, psnr) for sequence, psnr in {"0": 30.0, "1": 20.0}.items()),
        *(cell("worse", sequence, 0, psnr) for sequence, psnr in {"0": 29.0, "1": 19.0}.items()),
        *(cell("partial", sequence, 0, psnr) for sequence, psnr in {"0": 28.0, "1": None}.items()),
    )
    means = table.means().query("metric == 'psnr'").set_index("method")
    assert means.loc["whole", "rank"] == 1
    assert means.loc["worse", "rank"] == 2
    assert np.isnan(means.loc["partial", "rank"])
    text = markdown(lay_out(table, None))
    assert "| whole | **25.00** |" in text
    assert "| worse | <u>24.00</u>° |" in text
    assert "| partial | 28.00 (1/2) |" in text


def test_nobody_is_behind_for_being_better() -> None:
    """`partial` lacks a capture and so competes for no rank, but wins on all that it has; `late`
    lacks one, too, and loses.
    """
    table = results(
        *(cell("whole", str(i), 0, 20.0 + i) for i in range(12)),
        *(cell("other", str(i), 0, 19.0 + i % 7) for i in range(12)),
        *(cell("partial", str(i), 0, 25.0 + i if i else None) for i in range(12)),
        *(cell("late", str(i), 0, 15.0 + i if i else None) for i in range(12)),
    )
    means = table.means().query("metric == 'psnr'").set_index("method")
    assert means.loc["whole", "rank"] == 1
    assert means.loc["partial", "p_best"] == means.loc["late", "p_best"] == 2 / 2**11
    assert not means.loc["partial", "behind_best"]
    assert means.loc["late", "behind_best"]


def test_who_is_left_is_not_the_best() -> None:
    """Most methods lack a capture: the few that do not are not winners."""
    names = ("a", "b", "c")
    table = results(
        *(cell(name, str(i), 0, 20.0 if i else None) for name in names for i in range(8)),
        *(cell("whole", str(i), 0, 10.0) for i in range(8)),
    )
    means = table.means().query("metric == 'psnr'")
    assert means["rank"].isna().all()
    assert means["p_best"].isna().all()
    assert not means["behind_best"].any()
    assert "| whole | 10.00 |" in markdown(lay_out(table, None))


def test_memory_and_a_conditional_distance_rank_nobody() -> None:
    table = results(
        *(cell("a", str(i), 0, 30.0, {"accuracy_distance": 0.01}) for i in range(8)),
        *(cell("b", str(i), 0, 20.0, {"accuracy_distance": 0.09}) for i in range(8)),
    )
    means = table.means().set_index(["metric", "method"])
    unranked = means.loc[["accuracy_distance", "peak_memory_mib"]]
    assert unranked["rank"].isna().all()
    assert not unranked["behind_best"].any()
    assert means.loc[("psnr", "b"), "behind_best"]


def test_a_panel_says_over_how_many_captures() -> None:
    few = lay_out(results(*(cell("a", str(i), 0, 30.0 + i) for i in range(4))), None).panels[0]
    assert few.title.endswith("random inputs (4 captures: too few to tell methods apart)")
    enough = lay_out(results(*(cell("a", str(i), 0, 30.0 + i) for i in range(6))), None).panels[0]
    assert enough.title.endswith("random inputs (6 captures)")
    spread = "over 6 captures, 6 cells"
    assert enough.rows[0].entries[0].title == f"95 % interval 30.54 to 34.46 {spread}"
    one = lay_out(results(cell("a", "0", 0, 30.0)), None).panels[0]
    assert one.rows[0].entries[0].title == "no interval: a single capture, 1 cells"


def test_depth_from_files_is_not_said_to_come_from_the_inputs() -> None:
    table = results(cell("a", "0", 0, 30.0))
    assert "estimated from the inputs" in lay_out(table, None).title
    table = replace(table, plan=replace(table.plan, depth_from_files=True))
    title = lay_out(table, None).title
    assert "from files" in title
    assert "estimated" not in title


def test_what_was_given_is_said_of_everycell() -> None:
    table = results(
        cell("ours", "0", 0, 30.0, depth="used", ended="time"),
        cell("ours", "1", 0, 30.0, depth="used", ended="steps"),
        cell("ours", "2", 0, 30.0, depth="used", ended="steps"),
    )
    inputs = lay_out(table, None).inputs
    assert inputs.headings == ["depth", "ended"]
    assert inputs.rows == [("ours", ["used", "steps (2 cells) / time (1 cells)"])]


def test_what_differs_in_its_numbers_only_is_said_once() -> None:
    table = results(
        cell("ours", "0", 0, 30.0, init="9 points of 2 inputs, 0.5 random"),
        cell("ours", "1", 0, 30.0, init="120 points of 2 inputs, 0.25 random"),
        cell("ours", "2", 0, 30.0, init="none"),
    )
    ranges = "9 to 120 points of 2 inputs, 0.25 to 0.5 random (2 cells)"
    assert lay_out(table, None).inputs.rows == [("ours", [f"{ranges} / none (1 cells)"])]


def _layout() -> Layout:
    rows = [
        Row("A & B", "one", [Entry("30.00", 30.0, 1), Entry("–", None)]),
        Row("C_1", "two", [Entry("29.00", 29.0, 2, ties_best=True), Entry("0.2", 0.2, 1)]),
    ]
    panel = Panel("Everything, random inputs", [("PSNR ↑", 3), ("DISTS ↓", 3)], rows)
    inputs = Inputs(["device & init"], [("A & B", ["cpu_0"])])
    return Layout("A table", [panel], [], panel, inputs, ["dists: no weights"], ["a note, 95 %"])


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
    assert text.count(r"\midrule") == 5  # under three heads, and between both groups twice
    assert text.count("{") == text.count("}")
