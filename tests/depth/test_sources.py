from dataclasses import replace

import pytest
import torch
from traced_scenes import SCENES, orbit_camera, render

from extrap_train.config import DatasetDepthConfig, DepthConfig, StereoConfig
from extrap_train.depth import DatasetDepth, DepthSource
from extrap_train.depth.sources import depth_source
from extrap_train.depth.stereo import PlaneSweepStereo
from extrap_train.errors import InputError
from extrap_train.geometry.cameras import unproject_to_world
from extrap_train.views import View


def test_the_options_choose_the_source():
    assert depth_source(DatasetDepthConfig()) == DatasetDepth()
    stereo = depth_source(StereoConfig(planes=32))
    assert stereo == PlaneSweepStereo(StereoConfig(planes=32))
    assert isinstance(stereo, DepthSource)
    with pytest.raises(InputError, match="radar"):
        depth_source(DepthConfig("radar"))


def test_dataset_depth_is_the_views_own_and_sure_where_known():
    depth = torch.ones(4, 5)
    depth[1, 2] = 0
    view = View(torch.zeros(3, 4, 5), orbit_camera(0, 5).cropped(0, 0, 4, 5), depth)
    (found,) = DatasetDepth().depth_maps([view])
    assert torch.equal(found.depth, depth)
    assert torch.equal(found.confidence, depth)


def test_dataset_point_maps_meet_in_the_first_frame():
    one, two = (render(SCENES["slanted plane"], orbit_camera(a, 16)) for a in (0, 30))
    maps = DatasetDepth().point_maps(one, two)
    cam_to_world = one.camera.cam_to_world
    for points, view in ((maps.first, one), (maps.second, two)):
        world = points @ cam_to_world[:3, :3].mT + cam_to_world[:3, 3]
        torch.testing.assert_close(world, unproject_to_world(view.depth, view.camera))


def test_a_view_without_depth_names_the_remedy():
    view = View(torch.zeros(3, 8, 8), orbit_camera(0, 8), name="frame000001.jpg")
    with pytest.raises(InputError, match=r"frame000001\.jpg.*depth=stereo"):
        DatasetDepth().depth_map(view, [])
    with pytest.raises(InputError, match=r"frame000001\.jpg.*depth=stereo"):
        DatasetDepth().depth_maps([view, view])


def test_one_view_without_depth_among_others_is_unknown():
    known = render(SCENES["slanted plane"], orbit_camera(0, 16))
    found = DatasetDepth().depth_maps([known, replace(known, depth=None)])
    assert torch.equal(found[0].depth, known.depth)
    assert not found[1].depth.any()
    assert not found[1].confidence.any()
