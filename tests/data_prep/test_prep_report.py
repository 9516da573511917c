import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from orbits import capture, even, ring, textured_capture
from PIL import Image
from rich.console import Console

from data_prep import prep_report
from data_prep.prep_report import (
    correction_facts,
    coverage,
    draw_pair_sheet,
    error_histogram,
    write_report,
)
from data_prep.preparation import prepare
from extrap_train.config import FlowMatcherConfig, PrepConfig
from extrap_train.data.prepared import Pairs, PreparedData
from extrap_train.depth import DatasetDepth
from extrap_train.matching.dense_flow import FlowMatcher


@pytest.fixture
def data(tmp_path: Path) -> PreparedData:
    sequences = [capture(ring(even(24)), str(i)) for i in range(3)]
    sequences += [capture(ring(even(24, 90)), "evil|name\n[red] <script>")]
    options = PrepConfig(image_size=16)
    return prepare(
        sequences, DatasetDepth(), options, test_names=1, folder=tmp_path / "cup", progress=False
    )


def test_the_page_says_what_was_kept_and_why_not(data: PreparedData) -> None:
    console = Console(record=True, width=120, quiet=False, file=None)
    page = write_report(data, console).read_text()
    assert "<th>sequences kept</th><td>3 of 4</td>" in page
    assert f"<th>train pairs</th><td>{len(data.pairs('train'))}</td>" in page
    assert "<td>cup/evil|name\n[red] &lt;script&gt;</td><td>covers 86°" in page
    assert "<script" not in page
    assert "covers #° &lt; #°" in page
    printed = console.export_text()
    assert "3 of 4" in printed
    assert "covers #°" in printed


def test_a_file_that_is_named_can_be_found(tmp_path: Path) -> None:
    sequences = [capture(ring(even(24)), str(i)) for i in range(3)]
    sequences += [capture(ring(even(24)), "/eyes2_run/s7", broken=(4, 5, 6))]
    options, folder = PrepConfig(image_size=16), tmp_path / "cup"
    data = prepare(sequences, DatasetDepth(), options, test_names=1, folder=folder, progress=False)
    console = Console(record=True, width=300, quiet=False, file=None)
    page = write_report(data, console).read_text()
    reason = "3 of 24 frames cannot be used, the first because of /eyes2_run/s7/frame4.jpg: trunc"
    assert reason in page
    assert reason in console.export_text()


def test_the_table_of_pairs_is_read_once_for_all_pictures(
    data: PreparedData, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read, splits = PreparedData.pairs, []
    monkeypatch.setattr(
        PreparedData, "pairs", lambda self, split: splits.append(split) or read(self, split)
    )
    draw_pair_sheet(data, [0, 1, 2], tmp_path / "sheet.png")
    assert splits == ["train"]


def test_the_rows_of_a_sheet_say_which_pairs_they_show(
    data: PreparedData, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []
    monkeypatch.setattr(
        prep_report, "draw_contact_sheet", lambda columns, path, captions: said.extend(captions)
    )
    draw_pair_sheet(data, [5, 2], tmp_path / "sheet.png")
    pairs = data.pairs("train")
    for number, (index, caption) in enumerate(zip([5, 2], said, strict=True), start=1):
        names = data.names(pairs.sequence[index])
        reference, query = names[pairs.reference[index]], names[pairs.query[index]]
        angle = np.degrees(pairs.angle_rad[index])
        where = pairs.sequence[index]
        assert caption == f"{number}: {angle:.0f}°, {where}, {reference} → {query}"


def test_its_pictures_are_there_and_not_blank(data: PreparedData) -> None:
    page = write_report(data, Console(quiet=True))
    for name in ("pairs", "histograms", "coverage"):
        assert f'src="{name}.png"' in page.read_text()
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
    assert "<th>test pairs</th><td>0</td>" in write_report(data, Console(quiet=True)).read_text()


def test_held_out_frames_of_a_lone_sequence_are_drawn_as_test(tmp_path: Path) -> None:
    options = PrepConfig(image_size=16)
    data = prepare(
        [capture(ring(even(24)))],
        DatasetDepth(),
        options,
        test_names=1,
        folder=tmp_path / "cup",
        progress=False,
    )
    (axes,) = coverage(data).axes
    count = {str(line.get_color()): np.size(line.get_xdata()) for line in axes.lines}
    assert count == {"tab:blue": 20, "tab:orange": 4}


def test_the_histogram_of_errors_counts_what_it_cuts_off() -> None:
    errors = np.append(np.linspace(0.01, 0.02, 199), 0.5).astype(np.float32)
    none = np.zeros(200, np.int32)
    pairs = Pairs(
        sequence=np.full(200, "cup/0"),
        reference=none,
        query=none,
        angle_rad=errors,
        score=errors,
        flow=none,
        error_before=errors,
        error_after=errors / 4,
        uncorrected=np.full(200, ""),
    )
    (axes,) = error_histogram(pairs).axes
    _, labels = axes.get_legend_handles_labels()
    assert labels == ["before (2 beyond 0.02)", "after (1 beyond 0.02)"]


def test_reasons_that_are_equally_frequent_are_both_said(
    data: PreparedData, monkeypatch: pytest.MonkeyPatch
) -> None:
    pairs = data.pairs("train")
    half, odd = divmod(len(pairs), 2)
    reasons = ["too few matches: 3"] * half + ["no gain"] * half + [""] * odd
    uncorrected = replace(pairs, uncorrected=np.array(reasons))
    monkeypatch.setattr(PreparedData, "pairs", lambda self, split: uncorrected)
    facts = correction_facts(data)
    assert facts["left alone because too few matches: #"] == str(half)
    assert facts["left alone because no gain"] == str(half)


def test_corrections_and_the_worst_pairs_are_shown(tmp_path: Path) -> None:
    data = prepare(
        [textured_capture(str(i)) for i in range(2)],
        DatasetDepth(),
        PrepConfig(image_size=64, max_uses=2),
        test_names=1,
        folder=tmp_path / "cup",
        matcher=FlowMatcher(FlowMatcherConfig()),
        progress=False,
    )
    pairs = data.pairs("train")
    page = write_report(data, Console(quiet=True))
    text = page.read_text()
    assert f"The worst {min(20, len(pairs))} pairs" in text
    worst = np.nanmax(pairs.error_after)
    assert f'<td class="number">{worst:.4f}</td>' in text
    assert (pairs.flow >= 0).any()
    assert re.search(
        r"taken away</th><td>median [\d.]+%, 5 % and 95 % quantiles [\d.]+% and [\d.]+%</td>", text
    )
    assert re.search(r"<td>cup/\d</td><td>frame\d+ → frame\d+</td>", text)
    for name in ("worst", "correction"):
        assert np.asarray(Image.open(page.with_name(f"{name}.png"))).std() > 5
