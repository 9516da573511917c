"""The timed splat computes what its plain reference computes, and rows reach the CSV."""

import csv

import torch

from benchmarks.__main__ import main
from benchmarks.perf.timing import Timing, compare, write_rows
from benchmarks.perf.warp_timing import bumpy_views, orbit_camera, splat_reference
from extrap_train.geometry.warp import splat_points


def test_reference_is_equal():
    points, values = bumpy_views(48)
    query = orbit_camera(15.0, 48)
    drawn = splat_points(points, values, query)
    reference = splat_reference(points, values, query).permute(2, 0, 1)
    assert torch.allclose(drawn[:-1], reference[:-1], atol=1e-4)
    assert torch.allclose(drawn[-1], reference[-1], atol=1e-4)


def test_rows_are_written_with_the_contract_columns(tmp_path):
    row = compare("case", torch.device("cpu"), lambda: torch.ones(2), lambda: torch.zeros(2), 3)
    assert isinstance(row, Timing)
    write_rows([row], tmp_path / "perf" / "x.csv")
    with (tmp_path / "perf" / "x.csv").open() as file:
        (line,) = csv.DictReader(file)
    assert list(line) == ["case", "device", "ours_ms", "reference_ms", "ratio", "max_abs_diff"]
    assert float(line["max_abs_diff"]) == 1.0


def test_list_names_the_categories(capsys):
    assert main(["list", "categories"]) == 0
    assert "hydrant" in capsys.readouterr().out
