"""Photographs placed by a matcher's matches, which are known exactly of rendered pictures."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from aligned_cameras import pose_errors
from PIL import Image
from traced_scenes import SCENES, orbit_camera, render

from extrap_train.config import AlikedMatcherConfig, OwnMatcherConfig
from extrap_train.data import estimated_poses
from extrap_train.data.image_files import to_eight_bits
from extrap_train.data.picture_matches import CELL, keep_best, merge_points
from extrap_train.data.scene_spec import open_scene
from extrap_train.errors import InputError
from extrap_train.geometry.cameras import pixel_grid, project, unproject_to_world
from extrap_train.matching import Matches

pytest.importorskip("pycolmap", reason="needs pycolmap: the extra `poses`")

HEIGHT, WIDTH = 240, 320
FOCAL = 1.2 * WIDTH
SCENE = SCENES["box on the ground"]
AZIMUTHS = (0, 14, 28, 42, 56)
STRIDE = 8


def _view(azimuth):
    lens = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    square = orbit_camera(azimuth, WIDTH)
    camera = replace(square, intrinsics=lens, height=HEIGHT, width=WIDTH)
    return render(SCENE, camera)


VIEWS = [_view(azimuth) for azimuth in AZIMUTHS]


@dataclass(frozen=True)
class ExactMatcher:
    """Without a detector: every 8th pixel of the first picture, wherever it is in the second.

    A share of the matches is wrong.
    """

    wrong: float = 0.1

    def match(self, first, second, first_known=None):
        one, two = (
            min(VIEWS, key=lambda v: float((v.image - x).abs().mean())) for x in (first, second)
        )
        part = slice(STRIDE // 2, None, STRIDE)
        pixels = pixel_grid(HEIGHT, WIDTH)[part, part].flatten(0, 1)
        points = unproject_to_world(one.depth, one.camera)[part, part].flatten(0, 1)
        there, depth = project(points, two.camera)
        column, row = there.floor().long().unbind(-1)
        seen = (column >= 0) & (column < WIDTH) & (row >= 0) & (row < HEIGHT)
        stored = two.depth[row.clamp(0, HEIGHT - 1), column.clamp(0, WIDTH - 1)]
        seen &= (stored / depth - 1).abs() < 0.02
        found = Matches(pixels[seen], there[seen], torch.full((int(seen.sum()),), 0.5))
        generator = torch.Generator().manual_seed(0)
        wrong = torch.rand(len(found), generator=generator) < self.wrong
        moved = torch.rand(len(found), 2, generator=generator) * torch.tensor([WIDTH, HEIGHT])
        return replace(found, second=torch.where(wrong[:, None], moved, found.second))


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("photographs")
    for number, view in enumerate(VIEWS):
        picture = Image.fromarray(to_eight_bits(view.image).transpose(1, 2, 0))
        picture.save(folder / f"{number}.png")
    return str(folder)


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory):
    """A cache of this module's own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


def _exact(wrong=0.1):
    return OwnMatcherConfig(
        name="exact", factory=f"{__name__}.ExactMatcher", options={"wrong": wrong}
    )


def test_cameras_follow_from_any_matchers_matches(photographs, monkeypatch):
    opened = open_scene(photographs, poses=_exact())
    assert len(opened.frames) == len(VIEWS)
    errors = pose_errors([f.camera for f in opened.frames], [v.camera for v in VIEWS])
    assert errors.rotation_deg.max() < 0.5
    assert errors.translation.max() < 0.01  # of the orbit's radius
    for frame in opened.frames:
        assert frame.camera.intrinsics[0, 0] == pytest.approx(FOCAL, rel=0.02)
    assert "matches of exact" in opened.poses

    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(estimated_poses, "_run", stop)
    assert open_scene(photographs, poses=_exact()).poses == opened.poses  # from the cache
    for other in (_exact(0.2), None):
        with pytest.raises(KeyboardInterrupt):
            open_scene(photographs, poses=other)


def test_weights_that_are_missing_are_named(photographs, tmp_path):
    absent = AlikedMatcherConfig(checkpoint=str(tmp_path / "aliked-n16.pth"))
    with pytest.raises(InputError, match=r"poses\.checkpoint=FILE"):
        open_scene(photographs, poses=absent)


def test_points_of_a_cell_are_one_keypoint():
    first = np.array([[0.2, 0.2], [10.0, 3.0]])
    second = np.array([[CELL - 0.2, CELL - 0.2], [CELL + 0.1, 0.2], [10.0, 3.0]])
    keypoints, (ones, twos) = merge_points([first, second])
    assert len(keypoints) == 3
    assert ones[0] == twos[0] != twos[1]
    assert ones[1] == twos[2]
    np.testing.assert_allclose(keypoints[ones[0]], [CELL / 2, CELL / 2])
    np.testing.assert_allclose(keypoints[twos[2]], [10.0, 3.0])


def test_a_keypoint_has_one_match_the_most_certain():
    pairs = np.array([[0, 5], [0, 6], [1, 6], [2, 7]])
    kept = keep_best(pairs, np.array([0.5, 0.9, 0.8, 0.1]))
    assert sorted(map(tuple, kept.tolist())) == [(0, 6), (2, 7)]


def test_a_network_looks_at_each_photograph_once(photographs, tmp_path, monkeypatch):
    described = []

    class Separable(ExactMatcher):
        def describe(self, image):
            described.append(image)
            return image

        def match_described(self, first, second):
            return self.match(first, second)

    monkeypatch.setattr(estimated_poses, "matcher", lambda config, option: Separable())
    monkeypatch.setattr(estimated_poses, "_run", lambda work, count: None)
    with pytest.raises(InputError, match="too little in common"):  # nothing was run
        open_scene(photographs, poses=_exact(0.3))
    assert len(described) == len(VIEWS)
