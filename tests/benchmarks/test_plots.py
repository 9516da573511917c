"""What the plots over the angle draw: captures as samples, and no pooling of numbers of views."""

import numpy as np
import pandas as pd
import pytest

from benchmarks.report.plots import binned, plots
from tests.benchmarks.made import cell, results


def _images(*rows: tuple[str, float, float]) -> pd.DataFrame:
    table = pd.DataFrame(rows, columns=["sequence", "angle_deg", "value"])
    return table.assign(category="cup", method="a", draw="random", n_views=3, metric="psnr")


def test_a_point_is_the_mean_of_captures_whatever_images_they_have() -> None:
    """Thirty images of one capture and two of another are two samples."""
    near = [("0", 25.0, 20.0)] * 30 + [("1", 35.0, 30.0), ("1", 21.0, 34.0)]
    found = binned(_images(*near, ("1", 61.0, 9.0)))
    assert list(found.index) == [30.0, 70.0]
    assert found.loc[30.0, "mean"] == (20 + 32) / 2
    assert found.loc[30.0, "error"] == pytest.approx(np.std([20, 32], ddof=1) / np.sqrt(2))
    assert list(found["captures"]) == [2, 1]
    assert np.isnan(found.loc[70.0, "error"])


def test_every_number_of_views_has_its_own_panel() -> None:
    """Where six views are near and good and three are far and bad, one curve would show an effect
    of the angle that neither has.
    """
    table = results(cell("a", "0", 0, 20.0), cell("b", "0", 0, 20.0))
    three = _images(("0", 50.0, 20.0), ("1", 70.0, 20.0))
    six = _images(("0", 10.0, 30.0), ("1", 30.0, 30.0)).assign(n_views=6)
    images = pd.concat([three, six, six.assign(method="b", draw="spread")])
    vars(table)["by_image"] = images
    svg = plots(table)["psnr_over_angle"]
    for draw in ("random", "spread"):
        for views in (3, 6):
            assert svg.count(f"<!-- {draw} inputs, {views} views -->") == 1
    assert svg.count("<!-- b -->") == 1, "the legend holds what only one panel shows"
