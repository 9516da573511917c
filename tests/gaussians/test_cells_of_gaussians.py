"""Gaussian methods through the runner: trouble inside one is a cell with its reason."""

import json
from multiprocessing.context import ForkServerContext
from pathlib import Path

import pandas as pd
import pytest

from benchmarks.catalogue import Catalogue
from benchmarks.run_table import RunOptions, run_table
from extrap_train.jobs.local import LocalLauncher

_TABLE = """
title: Trouble
captures: {source: synthetic, categories: [apple], sequences: 1, frames: 10, render_size: 24}
rules: {image_size: 24, views: [3], draws: [spread]}
draws: [spread]
methods: [wild, full]
columns: [psnr, seconds]
scoring: {dists: false, lpips: []}
"""
_METHOD = """
title: {name}
factory: benchmarks.methods.threedgs.ThreeDgs
options: {{iterations: 30, full_iterations: 240, init: random, init_points: 100, {more}}}
"""
_METHODS = {
    "wild": "log_scales_rate: 100000.0, means_rate: 1.0e+30, means_rate_final: 1.0e+30",
    "full": "max_gaussians: 110, densify_from: 0, densify_gradient: 0.0",
}


@pytest.fixture(scope="module")
def results(fork_server: ForkServerContext, tmp_path_factory: pytest.TempPathFactory) -> Path:
    own, output = tmp_path_factory.mktemp("own"), tmp_path_factory.mktemp("results")
    for kind in ("method", "table"):
        (own / kind).mkdir()
    for name, more in _METHODS.items():
        (own / "method" / f"{name}.yaml").write_text(_METHOD.format(name=name, more=more))
    (own / "table" / "trouble.yaml").write_text(_TABLE)
    catalogue = Catalogue.with_own([str(own)])
    table = catalogue.table("trouble", [f"output={output}"])
    failed = run_table(table, catalogue, RunOptions(launcher=LocalLauncher(1)))
    cells = _cells(output / "trouble")
    assert failed == 1, {name: cell["reason"] for name, cell in cells.items()}
    return output / "trouble"


def _cells(results: Path) -> dict[str, dict]:
    found = [json.loads(file.read_text()) for file in results.glob("cells/*/cell.json")]
    return {cell["method"]: cell for cell in found}


def test_an_optimisation_that_diverges_is_a_failed_cell_with_its_reason(results: Path) -> None:
    cell = _cells(results)["wild"]
    assert cell["status"] == "failed"
    assert cell["reason"].startswith("Diverged: ")
    assert "in iteration" in cell["reason"]
    assert "lower the learning rates" in cell["reason"]
    assert not cell.get("metrics")
    rows = pd.read_csv(results / "trouble.csv").set_index("method")
    assert set(rows.loc[["wild"], "status"]) == {"failed"}
    assert rows.loc[["wild"], "value"].isna().all()
    assert "Diverged" in (results / "trouble.md").read_text()


def test_the_limit_on_gaussians_stops_growth_and_stands_in_the_cell(results: Path) -> None:
    cell = _cells(results)["full"]
    assert cell["status"] == "ok"
    assert cell["counts"]["gaussians"] <= 110
    assert cell["given"]["growth"] == "stopped at 110 Gaussians"
