from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from orbits import capture, even, looking_at, ring

from data_prep.filter import judge, judge_all
from extrap_train.config import PrepConfig
from extrap_train.data.co3d import read_category

OPTIONS = PrepConfig()


@pytest.mark.parametrize(
    "azimuths",
    [even(24), even(40, 720), even(60, 1080) + 3, np.r_[even(22, 330)], even(24)[::-1].copy()],
    ids=["circle", "two turns", "three turns", "open by 45°", "clockwise"],
)
def test_circles_are_kept(azimuths: np.ndarray) -> None:
    verdict = judge(capture(ring(azimuths)), OPTIONS)
    assert verdict.kept, verdict.reason
    assert verdict.gap_deg <= 30
    assert verdict.coverage_deg >= 300


def test_gap_and_coverage_are_measured() -> None:
    azimuths = np.r_[np.arange(0, 101, 10), np.arange(125, 316, 10)]
    verdict = judge(capture(ring(azimuths, 35)), OPTIONS)
    assert verdict.gap_deg == pytest.approx(25, abs=0.1)
    assert verdict.coverage_deg == pytest.approx(315, abs=0.1)


@pytest.mark.parametrize(
    ("azimuths", "reason"),
    [
        (even(24, 200), "covers 192° < 300°"),
        (np.r_[even(10, 100), even(15, 200) + 135], "azimuth gap 38° > 30°"),
        (even(5), "5 frames, fewer than 8"),
    ],
)
def test_others_are_dropped_with_the_reason(azimuths: np.ndarray, reason: str) -> None:
    verdict = judge(capture(ring(azimuths)), OPTIONS)
    assert not verdict.kept
    assert reason in verdict.reason
    assert judge(capture(ring(azimuths)), replace(OPTIONS, full_circle="ignore")).kept


def test_an_elliptical_high_orbit_is_kept() -> None:
    radius = 2 + np.cos(np.radians(2 * even(30)))
    assert judge(capture(ring(even(30), 50, radius)), OPTIONS).kept


def test_a_line_and_a_point_and_a_panorama_are_no_circles() -> None:
    line = np.stack([np.linspace(-1, 1, 12), np.full(12, -3.0), np.zeros(12)], 1)
    assert "covers" in judge(capture(looking_at(line, np.zeros(3))), OPTIONS).reason
    tripod = ring(even(24))
    tripod.world_to_cam[:, :3, 3] = 0
    assert "one place" in judge(capture(tripod), OPTIONS).reason
    outwards = ring(even(24), 0)
    outwards.world_to_cam[:, [0, 2]] *= -1
    assert not judge(capture(outwards), OPTIONS).kept


@pytest.mark.parametrize(("every", "kept"), [(6, False), (12, True)])
def test_a_tenth_of_the_cameras_may_look_away(every: int, kept: bool) -> None:
    circle = ring(even(24), 0)
    circle.world_to_cam[::every, [0, 2]] *= -1
    verdict = judge(capture(circle), OPTIONS)
    assert verdict.kept == kept
    assert ("face a common centre" in verdict.reason) == (not kept)


def test_overhead_views_do_not_fill_a_gap() -> None:
    half, top = ring(even(12, 180)), ring(even(12), 85)
    both = torch.cat([half.world_to_cam, top.world_to_cam])
    camera = replace(half, world_to_cam=both, intrinsics=half.intrinsics[:1].expand(24, 3, 3))
    assert not judge(capture(camera), OPTIONS).kept


def test_stated_qualities_count_and_missing_ones_do_not() -> None:
    camera = ring(even(24))
    assert judge(capture(camera, viewpoint_quality=0.5, point_cloud_quality=1.0), OPTIONS).kept
    poor = judge(capture(camera, viewpoint_quality=-0.5, point_cloud_quality=-3.0), OPTIONS)
    assert poor.reason == "viewpoint quality -0.50 < 0; point cloud quality -3.00 < -2"
    limits = {"viewpoint_quality": OPTIONS.min_viewpoint_quality}
    limits |= {"point_cloud_quality": OPTIONS.min_point_cloud_quality}
    assert judge(capture(camera, **limits), OPTIONS).kept
    unstated = capture(camera, viewpoint_quality=float("nan"), point_cloud_quality=float("nan"))
    assert judge(unstated, OPTIONS).kept


def test_a_nan_camera_is_named() -> None:
    camera = ring(even(24))
    camera.world_to_cam[7, 0, 3] = float("nan")
    verdict = judge(capture(camera), OPTIONS)
    assert not verdict.kept
    assert "degenerate camera" in verdict.reason
    assert "frame7" in verdict.reason


def test_partial_turns_are_kept_only_where_there_is_no_full_one(
    caplog: pytest.LogCaptureFixture,
) -> None:
    circle, arc = capture(ring(even(24))), capture(ring(even(24, 200)))
    poor = capture(ring(even(24, 200)), viewpoint_quality=-1.0)
    assert [v.kept for v in judge_all([circle, arc, poor], OPTIONS)] == [True, False, False]
    assert not caplog.text
    assert [v.kept for v in judge_all([arc, poor], OPTIONS)] == [True, False]
    assert "no sequence is a full circle (covers 192°" in caplog.text
    required = replace(OPTIONS, full_circle="require")
    assert not any(v.kept for v in judge_all([arc, poor], required))


def test_the_real_apple_is_sparse_but_turns_all_around(shared: Path) -> None:
    """Twenty frames of a CO3D turn: the largest gaps are 214° to 277° and 72° to 114°."""
    apple = read_category(shared / "data" / "co3d", "apple")
    verdict = judge(apple[0], OPTIONS)
    assert verdict.coverage_deg == pytest.approx(360 - 62.8, abs=1)
    assert verdict.gap_deg == pytest.approx(41.3, abs=1)
    assert [v.kept for v in judge_all(apple, OPTIONS)] == [True]
