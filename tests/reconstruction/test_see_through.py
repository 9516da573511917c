"""How well unobserved space tells what is seen through an object from what is known, by category.

`python -m pytest -s -m slow tests/reconstruction/test_see_through.py` prints the table of
docs/completion.md: three one-sided inputs, every other frame a query, captures of another seed than
any that a model was trained or a default chosen on. A pixel of the object is wrong where the warp
shows something that lies behind it by more than `BEHIND`.
"""

from collections import defaultdict
from dataclasses import dataclass, field

import numpy as np
import pytest
import torch

from extrap_train.config import StereoConfig, SyntheticConfig
from extrap_train.data.scene_spec import open_scene
from extrap_train.depth.stereo import PlaneSweepStereo
from extrap_train.geometry.viewpoints import directions_from, scene_center
from extrap_train.geometry.visibility import Ball, trace_visibility
from extrap_train.geometry.warp import warp_references
from extrap_train.reconstruction.inputs import choose_frames
from extrap_train.views import View, stack_cameras

CATEGORIES = ("apple", "book", "chair", "cup", "hydrant", "teddybear")
CAPTURES = SyntheticConfig(seed=917, frames=24, image_size=128)
BEHIND = 0.04
"""Share of the depth."""
THRESHOLDS = (0.02, 0.05, 0.1)
"""Unobserved length in the cameras' distances to the scene's centre."""
ANGLES_DEG = (25, 60, 110, 180)


@dataclass
class Counts:
    """Pixels of the object that the warp covers."""

    wrong: int = 0
    right: int = 0
    found: dict[float, int] = field(default_factory=lambda: defaultdict(int))
    flagged_right: dict[float, int] = field(default_factory=lambda: defaultdict(int))

    def add(self, wrong: torch.Tensor, right: torch.Tensor, length: torch.Tensor) -> None:
        self.wrong += int(wrong.sum())
        self.right += int(right.sum())
        for threshold in THRESHOLDS:
            self.found[threshold] += int((wrong & (length > threshold)).sum())
            self.flagged_right[threshold] += int((right & (length > threshold)).sum())

    def row(self) -> str:
        cells = [f"{self.wrong / max(self.wrong + self.right, 1):.2f}"]
        for threshold in THRESHOLDS:
            found, false = self.found[threshold], self.flagged_right[threshold]
            cells.append(f"{found / max(self.wrong, 1):.2f} / {found / max(found + false, 1):.2f}")
        return " | ".join(cells)


def with_depth(inputs: list[View], source: str) -> torch.Tensor:
    if source == "exact":
        depths = [view.depth for view in inputs]
        return torch.stack([depth for depth in depths if depth is not None])
    maps = PlaneSweepStereo(StereoConfig()).depth_maps(inputs)
    return torch.stack([found.reliable() for found in maps])


def count_capture(category: str, number: int, source: str, counts: dict[int, Counts]) -> None:
    frames = open_scene(f"synthetic:{category}/{number:04d}", CAPTURES).frames
    chosen = choose_frames(frames, 3, (), "one_sided", CAPTURES.seed)
    inputs = [frames[i].load() for i in chosen]
    cameras = stack_cameras([view.camera for view in inputs])
    center, ball = scene_center(cameras), Ball.around(cameras)
    distance = float((cameras.center - ball.center).norm(dim=1).median())
    towards = directions_from(cameras, center)
    images, depths = torch.stack([view.image for view in inputs]), with_depth(inputs, source)
    for i, frame in enumerate(frames):
        if i in chosen:
            continue
        truth = frame.load()
        assert truth.depth is not None
        assert truth.mask is not None
        query = stack_cameras([truth.camera])
        cosines = (towards @ directions_from(query, center).T)[:, 0].clip(-1, 1)
        order = torch.from_numpy(np.argsort(-cosines))
        near = stack_cameras([cameras[order]])
        valid = torch.ones(1, 3, dtype=torch.bool)
        warp = warp_references(images[order][None], depths[order][None], near, valid, query)
        seen = trace_visibility(depths[order][None], near, valid, query, warp.depth, ball)
        on_object = (truth.mask > 0.5) & (warp.mask[0] > 0)
        wrong = on_object & (warp.depth[0] > (1 + BEHIND) * truth.depth)
        angle_deg = float(np.degrees(np.arccos(cosines.max())))
        bucket = next(limit for limit in ANGLES_DEG if angle_deg <= limit)
        counts[bucket].add(wrong, on_object & ~wrong, seen.unobserved[0] / distance)


@pytest.mark.slow
@pytest.mark.parametrize("source", ["exact", "stereo"])
def test_what_is_seen_through_is_found(source: str) -> None:
    total: dict[int, Counts] = defaultdict(Counts)
    print(f"\n{source} depth: recall / precision at unobserved length > {THRESHOLDS}")
    for category in CATEGORIES:
        counts: dict[int, Counts] = defaultdict(Counts)
        for number in range(4):
            count_capture(category, number, source, counts)
        for limit in ANGLES_DEG:
            if limit in counts:
                print(f"| {category} | to {limit}° | {counts[limit].row()} |")
                merge(total[limit], counts[limit])
    for limit in ANGLES_DEG:
        print(f"| all | to {limit}° | {total[limit].row()} |")
    least = 0.8 if source == "exact" else 0.7
    for limit in (60, 110, 180):
        assert total[limit].found[0.05] > least * total[limit].wrong


def merge(total: Counts, part: Counts) -> None:
    total.wrong += part.wrong
    total.right += part.right
    for threshold in THRESHOLDS:
        total.found[threshold] += part.found[threshold]
        total.flagged_right[threshold] += part.flagged_right[threshold]
