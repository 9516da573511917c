"""Intervals, ranks and paired differences, against what is known of the numbers."""

import numpy as np
import pandas as pd
import pytest

from benchmarks.report.layout import Entry, Layout, Panel, Row
from benchmarks.report.text import latex, markdown
from benchmarks.results import direction, interval, is_behind


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
    table = pd.DataFrame({"a": scenes, "b": scenes - 0.1 + rng.normal(0, 0.02, 24)})
    assert interval(table["a"].to_numpy(), 0)[0] < interval(table["b"].to_numpy(), 0)[1]
    assert is_behind(table, "a", "b")
    assert not is_behind(table.assign(b=scenes + rng.normal(0, 1, 24)), "a", "b")
    assert not is_behind(table[:1], "a", "b")


def test_every_metric_has_its_direction() -> None:
    assert direction("lpips_vgg") == direction("dists") == direction("seconds") == -1
    assert direction("masked_psnr") == direction("tsed") == 1
    assert direction("coverage") == direction("warp_psnr_truth") == 0


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
