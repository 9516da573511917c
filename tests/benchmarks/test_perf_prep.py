"""The stages that are timed are those of a preparation, and their shares add up."""

from pathlib import Path

import pytest
from orbits import textured_capture

from benchmarks.perf import prep_timing as prep
from extrap_train.config import PrepConfig, StereoConfig
from extrap_train.depth.stereo import PlaneSweepStereo


def test_every_stage_has_its_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(prep, "STEREO", PlaneSweepStereo(StereoConfig(planes=8, image_size=32)))
    monkeypatch.setattr(prep, "OPTIONS", PrepConfig(image_size=32, max_uses=2))
    seconds, frames, pairs = prep.stages(textured_capture("a", count=8, size=64), tmp_path)
    assert frames == 8
    assert 0 < pairs <= 16
    assert min(seconds.values()) > 0
    assert seconds["fitting, warping, judging"] > seconds[prep.ONE_WARP]


def test_the_table_is_per_frame_and_counts_nothing_twice() -> None:
    lines = prep.table_of({"reading": 1.0, "stereo": 3.0, prep.ONE_WARP: 0.5}, 10, 7)
    rows = [line.rsplit(maxsplit=3) for line in lines[2:]]
    assert rows == [
        ["reading", "100.0", "10.0", "25%"],
        ["stereo", "300.0", "3.3", "75%"],
        [prep.ONE_WARP, "50.0", "20.0", "12%"],
        ["all", "400.0", "2.5", "100%"],
    ]
