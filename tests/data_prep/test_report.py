from pathlib import Path

import numpy as np
import pytest
from orbits import capture, even, ring
from PIL import Image
from rich.console import Console

from data_prep.build import prepare
from data_prep.report import write_report
from extrap_train.config import PrepConfig
from extrap_train.data.store import PreparedData
from extrap_train.depth.dataset import DatasetDepth


@pytest.fixture
def data(tmp_path: Path) -> PreparedData:
    sequences = [capture(ring(even(24)), str(i)) for i in range(3)]
    sequences += [capture(ring(even(24, 90)), "evil|name\n[red]")]
    options = PrepConfig(image_size=16)
    return prepare(
        sequences, DatasetDepth(), options, test_names=1, folder=tmp_path / "cup", progress=False
    )


def test_the_page_says_what_was_kept_and_why_not(data: PreparedData) -> None:
    console = Console(record=True, width=120, quiet=False, file=None)
    page = write_report(data, console).read_text()
    assert "| sequences kept | 3 of 4 |" in page
    assert f"| train pairs | {len(data.pairs('train'))} |" in page
    assert r"| cup/evil\|name [red] | covers 86°" in page
    printed = console.export_text()
    assert "3 of 4" in printed
    assert "covers 86°" in printed


def test_its_pictures_are_there_and_not_blank(data: PreparedData) -> None:
    page = write_report(data, Console(quiet=True))
    for name in ("pairs", "histograms", "coverage"):
        assert f"]({name}.png)" in page.read_text()
        assert np.asarray(Image.open(page.with_name(f"{name}.png"))).std() > 5


def test_a_lone_sequence_without_test_pairs_has_a_report_too(tmp_path: Path) -> None:
    options = PrepConfig(image_size=16, full_circle="ignore")
    data = prepare(
        [capture(ring(np.array([0.0, 40.0])))],
        DatasetDepth(),
        options,
        test_names=1,
        folder=tmp_path / "cup",
        progress=False,
    )
    assert "| test pairs | 0 |" in write_report(data, Console(quiet=True)).read_text()
