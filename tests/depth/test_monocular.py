import logging
from dataclasses import dataclass, replace

import pytest
import torch
from traced_scenes import SCENES, orbit_camera, render

from extrap_train.config import FlowMatcherConfig, MonocularConfig
from extrap_train.depth import DepthSource
from extrap_train.depth.monocular import MonocularDepth
from extrap_train.errors import InputError
from extrap_train.geometry.cameras import (
    pixel_grid,
    project,
    transform,
    unproject_to_world,
)
from extrap_train.matching import Matches
from extrap_train.matching.matchers import matcher

SCENE = SCENES["box on the ground"]


@dataclass
class Oracle:
    """The exact inverse depth of the picture it is shown, with a scale and a shift of its own."""

    views: list
    scale: float = 3.0
    image_size: int = 96

    def inverse_depth(self, image: torch.Tensor) -> torch.Tensor:
        view = next(view for view in self.views if torch.equal(view.image, image))
        return self.scale / view.depth + 5.0


def source_and_views(*azimuths_deg: float, scale: float = 3.0):
    views = [render(SCENE, orbit_camera(azimuth_deg, 96)) for azimuth_deg in azimuths_deg]
    network = Oracle(views, scale)
    return MonocularDepth(MonocularConfig(), network, matcher(FlowMatcherConfig())), views


def check(found, view):
    known = found.confidence > 0
    assert known.float().mean() > 0.9
    error = (found.depth / view.depth - 1).abs()[known]
    assert error.median() < 0.01
    assert error.quantile(0.95) < 0.05
    assert not found.depth[~known].any()


def test_scale_and_shift_come_from_matches_at_the_known_poses():
    source, views = source_and_views(0, 8, 16)
    assert isinstance(source, DepthSource)
    assert source.image_size == 96
    for found, view in zip(source.depth_maps(views), views, strict=True):
        check(found, view)
    check(source.depth_map(views[0], views[1:]), views[0])


def test_point_maps_meet_in_the_first_frame():
    source, views = source_and_views(0, 8)
    maps = source.point_maps(*views)
    for points, view in ((maps.first, views[0]), (maps.second, views[1])):
        world = unproject_to_world(view.depth, view.camera).flatten(0, 1)
        expected = transform(views[0].camera.world_to_cam, world).view_as(points)
        assert (points - expected).norm(dim=-1).median() < 0.03


def test_a_network_that_takes_near_for_far_is_not_believed(caplog):
    source, views = source_and_views(0, 8, scale=-3.0)
    with pytest.raises(InputError, match=r"the \d{3,} points .* contradict each other") as raised:
        source.depth_map(views[0], views[1:])
    assert "fewer than" not in str(raised.value)
    with caplog.at_level(logging.WARNING):
        assert not any(found.depth.any() for found in source.depth_maps(views))
    assert str(raised.value) in caplog.text


def test_a_network_that_says_nothing_is_said_to():
    source, views = source_and_views(0, 8, scale=0.0)
    with pytest.raises(InputError, match=r"says the same of all \d{3,} points"):
        source.depth_map(views[0], views[1:])


def test_too_few_points_are_said_or_unknown():
    source, views = source_and_views(0, 120)
    with pytest.raises(
        InputError, match=r"\d+ of its points .* fewer than the 20 .* another depth\.matcher"
    ):
        source.depth_map(views[0], views[1:])
    assert not any(found.depth.any() for found in source.depth_maps(views))


@dataclass(frozen=True)
class OneWrong:
    """A matcher that takes the middle of the first view for something far away."""

    views: list
    far: float

    def match(self, first: torch.Tensor, second: torch.Tensor) -> Matches:
        found = matcher(FlowMatcherConfig()).match(first, second)
        camera = self.views[0].camera
        middle = pixel_grid(96, 96)[48:49, 48]
        ray = torch.cat([middle, torch.ones(1, 1)], -1) @ camera.intrinsics.inverse().mT
        point = transform(camera.cam_to_world, ray * self.far)
        seen, _ = project(point, self.views[1].camera)
        return Matches(
            torch.cat([middle, found.first]),
            torch.cat([seen, found.second]),
            torch.cat([torch.ones(1), found.confidence]),
        )


def test_one_wrong_match_does_not_let_the_line_speak_of_what_is_far_away():
    source, views = source_and_views(0, 8)
    depth = views[0].depth.clone()
    depth[:20, :20] = 20.0  # so the network says; no match is there
    views[0] = replace(views[0], depth=depth)
    wrong = OneWrong(views, 9.0)
    source = MonocularDepth(MonocularConfig(), Oracle(views), wrong)
    depths = source._points(*views).depth.sort().values
    assert depths[-1] > 8.9
    assert depths[-2] < 20 / 3, "one of them is wrong"
    found = source.depth_map(views[0], views[1:])
    assert not found.depth[:20, :20].any()
    assert found.depth[40:56, 40:56].all()
