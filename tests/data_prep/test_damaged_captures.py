"""Photographs and depth maps that are damaged or gone: reported, and the rest is prepared."""

import logging
import shutil
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch
from captures import frame_entries, replace_frame_entries, write_capture
from orbits import capture, even, ring

from data_prep.__main__ import main as prepare
from data_prep.category_pairs import prepare_category
from extrap_train.__main__ import main as train
from extrap_train.config import (
    Co3dConfig,
    DatasetDepthConfig,
    DepthConfig,
    FlowMatcherConfig,
    PrepConfig,
    StereoConfig,
)
from extrap_train.data.prepared import PreparedData
from extrap_train.data.square_frames import make_frames
from extrap_train.depth import DatasetDepth, DepthMap
from extrap_train.errors import InputError
from extrap_train.views import View


@dataclass(frozen=True)
class Blind(DatasetDepth):
    """Finds no depth anywhere, as stereo does in black photographs."""

    size: int | None

    @property
    def image_size(self) -> int | None:  # type: ignore[override]
        return self.size

    def depth_maps(self, views: Sequence[View]) -> list[DepthMap]:
        return [DepthMap(*torch.zeros_like(view.image[:2])) for view in views]


NAMES = ("fine", "no_depth", "one_corrupt", "two_corrupt", "also_fine")
FRAMES = 12


@pytest.fixture
def photographs(tmp_path: Path) -> Path:
    write_capture(tmp_path / "co3d", NAMES, FRAMES)
    return tmp_path / "co3d"


def prepared(photographs: Path, depth: DepthConfig | None = None) -> PreparedData:
    return prepare_category(
        "cup",
        Co3dConfig(root=str(photographs), test_sequences=1),
        depth or DatasetDepthConfig(),
        PrepConfig(image_size=16, correct=False),
        output=photographs.parent / "outputs",
        workers=1,
        matcher=FlowMatcherConfig(),
        retry=True,
    )


def cut_short(photographs: Path, sequence: str, frame: int) -> Path:
    """Half of a photograph, as a broken download leaves it."""
    file = sorted((photographs / "cup" / sequence / "images").iterdir())[frame]
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    return file


def test_damaged_sequences_are_reported_and_the_rest_goes_on(
    photographs: Path, caplog: pytest.LogCaptureFixture
) -> None:
    shutil.rmtree(photographs / "cup" / "no_depth" / "depths")
    corrupt = cut_short(photographs, "one_corrupt", 5)
    first_of_two = cut_short(photographs, "two_corrupt", 5)
    cut_short(photographs, "two_corrupt", 6)
    with caplog.at_level(logging.WARNING):
        data = prepared(photographs)
    assert data.manifest["sequences"] == {"kept": 3, "dropped": 0, "failed": 2}
    reasons = data.sequences.set_index("sequence")["reason"]
    assert "12 of 12 frames cannot be used" in reasons["cup/no_depth"]
    assert "geometric.png: no such file" in reasons["cup/no_depth"]
    assert "2 of 12 frames cannot be used" in reasons["cup/two_corrupt"]
    assert f"{first_of_two}: is truncated or damaged" in reasons["cup/two_corrupt"]
    assert reasons["cup/no_depth"] in caplog.text
    counts = data.sequences.set_index("sequence")[["frames", "frames_left_out"]]
    assert counts.loc["cup/one_corrupt"].tolist() == [FRAMES - 1, 1]
    assert counts.loc["cup/fine"].tolist() == [FRAMES, 0]
    # One in twelve is not a reason to give a sequence up.
    assert corrupt.name not in data.names("cup/one_corrupt")
    assert len(data.names("cup/one_corrupt")) == FRAMES - 1
    assert f"1 frames left out: {corrupt}" in caplog.text


def test_degenerate_cameras_are_reported_and_the_rest_goes_on(photographs: Path) -> None:
    entries = frame_entries(photographs)
    spoilt = {("one_corrupt", 51), ("two_corrupt", 51), ("two_corrupt", 61)}
    for entry in entries:
        sequence, number = entry["sequence_name"], entry["frame_number"]
        if (sequence, number) in spoilt or sequence == "no_depth":
            entry["viewpoint"]["focal_length"] = [0, 0]
    replace_frame_entries(photographs, entries)
    data = prepared(photographs)
    assert data.manifest["sequences"] == {"kept": 3, "dropped": 2, "failed": 0}
    rows = data.sequences.set_index("sequence")
    assert "12 of 12 frames cannot be used" in rows["reason"]["cup/no_depth"]
    assert "2 of 12 frames cannot be used" in rows["reason"]["cup/two_corrupt"]
    assert "annotations.jgz: the camera of two_corrupt frame" in rows["reason"]["cup/two_corrupt"]
    assert rows.loc["cup/one_corrupt", ["frames", "frames_left_out"]].tolist() == [FRAMES - 1, 1]
    sound = [entry for entry in entries if entry["viewpoint"]["focal_length"] != [0, 0]]
    replace_frame_entries(photographs, sound)
    assert prepared(photographs).manifest["sequences"] == {"kept": 4, "dropped": 0, "failed": 0}


def test_unusable_cameras_and_photographs_count_together(photographs: Path) -> None:
    entries = frame_entries(photographs)
    for entry in entries:
        if (entry["sequence_name"], entry["frame_number"]) == ("fine", 51):
            entry["viewpoint"]["T"][0] = float("inf")
    replace_frame_entries(photographs, entries)
    cut_short(photographs, "fine", 8)
    reason = prepared(photographs).sequences.set_index("sequence")["reason"]["cup/fine"]
    assert "2 of 12 frames cannot be used" in reason


def test_estimated_depth_needs_none_of_the_data_sets(photographs: Path) -> None:
    for file in (photographs / "cup").glob("*/depths/*.png"):
        file.write_bytes(b"no picture")
    data = prepared(photographs, StereoConfig(image_size=32, planes=8))
    assert data.manifest["sequences"] == {"kept": len(NAMES), "dropped": 0, "failed": 0}
    assert data.depths("cup/fine", [0]).any()


def test_a_restored_sequence_is_taken_in_and_nothing_else_redone(photographs: Path) -> None:
    depths = photographs / "cup" / "no_depth" / "depths"
    depths.rename(photographs / "elsewhere")
    prepared(photographs)
    outputs = photographs.parent / "outputs"
    files = {f: f.stat().st_mtime_ns for f in outputs.glob("pairs/*/*/cup/*/pairs.parquet")}
    (photographs / "elsewhere").rename(depths)
    second = prepared(photographs)
    assert len(files) == len(NAMES) - 1
    assert second.manifest["sequences"] == {"kept": len(NAMES), "dropped": 0, "failed": 0}
    assert {file: file.stat().st_mtime_ns for file in files} == files


def test_a_restored_and_a_replaced_photograph_are_taken_in(photographs: Path) -> None:
    frames = photographs.parent / "outputs" / "frames"
    whole = sorted((photographs / "cup" / "fine" / "images").iterdir())[5].read_bytes()
    corrupt = cut_short(photographs, "fine", 5)
    assert corrupt.name not in prepared(photographs).names("cup/fine")
    others = {f: f.stat().st_mtime_ns for f in frames.rglob("*.npy") if f.parent.name != "fine"}
    corrupt.write_bytes(whole)
    restored = prepared(photographs)
    assert restored.names("cup/fine")[5] == corrupt.name
    before = restored.images("cup/fine", [5, 6]).float()
    corrupt.write_bytes(corrupt.with_name(restored.names("cup/fine")[6]).read_bytes())
    after = prepared(photographs).images("cup/fine", [5, 6]).float()
    assert (after[0] - before[0]).abs().max() > 25
    assert torch.equal(after[1], before[1])
    assert {file: file.stat().st_mtime_ns for file in others} == others


def test_a_frame_whose_annotation_names_no_depth_costs_no_more_than_itself(
    photographs: Path, caplog: pytest.LogCaptureFixture
) -> None:
    entries = frame_entries(photographs)
    (entry,) = (e for e in entries if (e["sequence_name"], e["frame_number"]) == ("fine", 51))
    entry["depth"] = None
    replace_frame_entries(photographs, entries)
    with caplog.at_level(logging.WARNING):
        data = prepared(photographs)
    name = Path(entry["image"]["path"]).name
    assert data.manifest["sequences"] == {"kept": len(NAMES), "dropped": 0, "failed": 0}
    assert f"1 of {FRAMES} views have no depth ({name}" in caplog.text
    # Its photograph is as good a query as any; a reference it cannot be.
    index = list(data.names("cup/fine")).index(name)
    pairs = [pair for split in ("train", "test") for pair in data.pairs(split)]
    ours = [pair for pair in pairs if pair.sequence == "cup/fine"]
    assert any(pair.query == index for pair in ours)
    assert not any(index in pair.references for pair in ours)


@pytest.mark.parametrize(
    ("size", "advice"), [(None, "use depth=stereo"), (32, "check for blank photographs")]
)
def test_a_sequence_without_depth_is_not_sent_where_it_comes_from(
    size: int | None, advice: str
) -> None:
    """Black photographs have no depth under depth=stereo either, whose advice cannot be itself."""
    source = Blind(size)
    sequence = capture(ring(even(12)), "black")
    with pytest.raises(InputError, match=f"no depth is known in any of its frames; {advice}"):
        make_frames(sequence, source, 16, lone=False)


@pytest.mark.parametrize(
    ("main", "alone"), [(prepare, "workers"), (train, "threads")], ids=["data_prep", "extrap_train"]
)
def test_the_command_line_says_what_it_leaves_out(
    main: Callable[[], None],
    alone: str,
    photographs: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for name in NAMES:
        shutil.rmtree(photographs / "cup" / name / "depths")
    options = [
        "category=cup",
        "data=co3d",
        f"data.root={photographs}",
        f"output={tmp_path / 'out'}",
    ]
    monkeypatch.setattr(logging.root, "handlers", [])  # without pytest's, warnings go to stderr
    monkeypatch.setattr(sys, "argv", ["", *options, f"{alone}=1", "prep.max_gap_deg=10"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 1
    said = capsys.readouterr().err
    lines = [line for part in said.splitlines() for line in part.split("\r") if line.strip()]
    said = [line for line in lines if not line.startswith("preparing:")]
    assert said[0].startswith("no sequence is a full circle (azimuth gap 30° > 10°)")
    for line, name in zip(said[1:-1], sorted(NAMES), strict=True):
        assert line.startswith(f"left out: sequence cup/{name}: 12 of 12 frames cannot be used")
    assert said[-1].startswith(f"error: none of the {len(NAMES)} sequences of cup can be used")
