"""Which captures are good enough to learn from (paper III-A.1), and why others are not."""

import logging
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from extrap_train.config import PrepConfig
from extrap_train.data.camera_check import CO3D_POSES, find_pose_fault, is_degenerate
from extrap_train.data.sequences import FrameSequence
from extrap_train.data.square_frames import too_many_unusable
from extrap_train.geometry.viewpoints import (
    LOOKS_AT_RAD,
    camera_centers,
    facing,
    fit_orbit,
    scene_center,
)
from extrap_train.views import Camera, stack_poses

LOG = logging.getLogger(__name__)

MIN_FRAMES = 8
"""Fewer do not make a capture; two do, where a full circle is not asked for."""
_MIN_FACING_SHARE = 0.9
_MAX_ELEVATION_RAD = math.radians(75)
"""Nearer to the orbit's pole an azimuth means nothing."""


@dataclass(frozen=True)
class Verdict:
    """Whether a sequence is kept, and what was measured."""

    kept: bool
    reason: str
    """Why it was dropped; empty where it was kept."""
    frames: int
    gap_deg: float = math.nan
    """Largest azimuth gap within the covered arc; NaN where it was not measured."""
    coverage_deg: float = math.nan
    """360° less the arc's opening, which is the largest gap of all."""


def judge_all(sequences: Sequence[FrameSequence], options: PrepConfig) -> list[Verdict]:
    """Keep or drop each sequence of a category.

    Where a full circle is preferred and none is there, every sequence that is sound otherwise is
    kept: a few photographs of one object still train something, and the log says what they lack.
    """
    verdicts = [judge(sequence, options) for sequence in sequences]
    if options.full_circle != "prefer" or any(verdict.kept for verdict in verdicts):
        return verdicts
    relaxed = [judge(sequence, replace(options, full_circle="ignore")) for sequence in sequences]
    if any(verdict.kept for verdict in relaxed):
        lacking = "; ".join(sorted({verdict.reason for verdict in verdicts})[:3])
        LOG.warning("no sequence is a full circle (%s): all that are sound are kept", lacking)
    return relaxed


def judge(sequence: FrameSequence, options: PrepConfig) -> Verdict:
    """Keep or drop a sequence; a quality that the capture does not state is not a reason."""
    count = len(sequence.frames)
    if too_many := too_many_unusable(sequence.left_out, sequence):
        return Verdict(False, too_many, count)
    circle = options.full_circle != "ignore"
    least = MIN_FRAMES if circle else 2
    if count < least:
        return Verdict(False, f"{count} frames, fewer than {least}", count)
    cameras = stack_poses([frame.camera for frame in sequence.frames])
    if len(unsound := is_degenerate(cameras).nonzero()):
        name = sequence.frames[int(unsound[0])].name
        reason = f"degenerate camera (NaN, no rotation, no focal length): {name}"
        return Verdict(False, reason, count)
    if fault := find_pose_fault(cameras, CO3D_POSES):
        return Verdict(False, fault, count)
    facing_share = float(facing(cameras, scene_center(cameras), LOOKS_AT_RAD).mean())
    gap, coverage = azimuth_coverage(cameras)
    reasons = _quality_reasons(sequence, options)
    if circle:
        reasons += _circle_reasons(facing_share, gap, coverage, options)
    return Verdict(not reasons, "; ".join(reasons), count, gap, coverage)


def azimuth_coverage(cameras: Camera) -> tuple[float, float]:
    """Largest gap within the covered arc, and the arc itself, in degrees around the orbit."""
    azimuths_rad, elevations_rad, _ = fit_orbit(cameras).locate(camera_centers(cameras))
    low = np.abs(elevations_rad) < _MAX_ELEVATION_RAD
    azimuths = np.degrees(np.sort(azimuths_rad[low]))
    gaps = np.sort(np.diff(azimuths, append=azimuths[:1] + 360))
    if len(gaps) < 2:
        return 0.0, 0.0
    return float(gaps[-2]), float(360 - gaps[-1])


def _quality_reasons(sequence: FrameSequence, options: PrepConfig) -> list[str]:
    scores = (
        ("viewpoint", sequence.viewpoint_quality, options.min_viewpoint_quality),
        ("point cloud", sequence.point_cloud_quality, options.min_point_cloud_quality),
    )
    return [
        f"{name} quality {score:.2f} < {least:g}"
        for name, score, least in scores
        if score is not None and score < least  # NaN says nothing, as None does
    ]


def _circle_reasons(
    facing_share: float, gap_deg: float, coverage_deg: float, options: PrepConfig
) -> list[str]:
    reasons = []
    if facing_share < _MIN_FACING_SHARE:
        reasons.append(f"only {facing_share:.0%} of the cameras face a common centre")
    if coverage_deg < options.min_coverage_deg:
        reasons.append(f"covers {coverage_deg:.0f}° < {options.min_coverage_deg:g}°")
    if gap_deg > options.max_gap_deg:
        reasons.append(f"azimuth gap {gap_deg:.0f}° > {options.max_gap_deg:g}°")
    return reasons


_PATH = re.compile(r"(?<!\S)/[^:;]+")
"""An absolute path, to the colon that ends it: a message goes on behind it."""
_NUMBER = re.compile(r"[0-9]+([.,][0-9]+)*")


@dataclass(frozen=True)
class ReasonGroup:
    """Reasons that are the same but for numbers and paths."""

    count: int
    example: str
    """The first of them."""
    differ: bool
    """Whether they are not all the same."""

    @property
    def short(self) -> str:
        """With # for the numbers; one that names files as it is: a path with # leads nowhere."""
        if _PATH.search(self.example):
            return f"for instance {self.example}" if self.differ else self.example
        return _NUMBER.sub("#", self.example)

    @property
    def counted(self) -> str:
        """How often, and the first."""
        times = "once" if self.count == 1 else f"{self.count} times"
        return f"{times}, for instance {self.example}" if self.differ else f"{times} {self.example}"


def group_reasons(reasons: Iterable[str]) -> list[ReasonGroup]:
    """Groups of equal reasons, the most frequent first."""
    members: dict[str, list[str]] = {}
    for reason in reasons:
        members.setdefault(_NUMBER.sub("#", _PATH.sub("/", reason)), []).append(reason)
    groups = [ReasonGroup(len(same), same[0], len({*same}) > 1) for same in members.values()]
    return sorted(groups, key=lambda group: -group.count)
