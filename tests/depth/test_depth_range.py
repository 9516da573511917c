from dataclasses import replace

import pytest
import torch
from traced_scenes import SCENES, orbit_camera, render

from extrap_train.depth.neighbours import convergence_point, inverse_depth_range
from extrap_train.depth.plane_sweep import sweep
from extrap_train.views import Camera, View


def test_the_center_is_where_the_optical_axes_meet():
    cameras = [orbit_camera(azimuth_deg, 64) for azimuth_deg in (0, 40, 100)]
    torch.testing.assert_close(convergence_point(cameras), torch.zeros(3), atol=1e-5, rtol=0)


def test_the_range_holds_the_scene_and_does_not_depend_on_its_unit():
    views = [render(SCENES["box on the ground"], orbit_camera(a, 64)) for a in (0, -15, 15)]
    cameras = [view.camera for view in views]
    least, greatest = inverse_depth_range(cameras[0], cameras[1:], convergence_point(cameras))
    assert 1 / greatest < views[0].depth.min()
    assert views[0].depth.max() < 1 / least

    large = [orbit_camera(azimuth_deg, 64, distance=220) for azimuth_deg in (0, -15, 15)]
    ends = inverse_depth_range(large[0], large[1:], convergence_point(large))
    torch.testing.assert_close(torch.tensor(ends) * 100, torch.tensor([least, greatest]))


@pytest.mark.parametrize(("apart_deg", "zoom"), [(40, 130), (40, 160), (20, 300)])
def test_cameras_so_long_that_one_candidate_alone_is_seen_have_a_range(apart_deg, zoom):
    camera, other = (orbit_camera(azimuth_deg, 64) for azimuth_deg in (0, apart_deg))
    factor = torch.tensor([[zoom, 1.0, 1.0], [1.0, zoom, 1.0], [1.0, 1.0, 1.0]])
    camera, other = (replace(c, intrinsics=c.intrinsics * factor) for c in (camera, other))
    bounds = inverse_depth_range(camera, [other], convergence_point([camera, other]))
    assert bounds[0] < 1 / float(camera.center.norm()) < bounds[1]
    view, neighbour = (View(torch.rand(3, 64, 64), c) for c in (camera, other))
    assert sweep(view, [neighbour], bounds, planes=3).inverse_depth.isfinite().all()


def test_parallel_cameras_have_no_center_but_a_range():
    intrinsics = torch.tensor([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]])
    left, right = Camera(torch.eye(4), intrinsics, 100, 100), torch.eye(4)
    right[0, 3] = -1
    cameras = [left, Camera(right, intrinsics, 100, 100)]
    assert convergence_point(cameras) is None
    least, greatest = inverse_depth_range(left, cameras[1:], None)
    assert 0 < least < greatest
    assert 100 * 1 * greatest == 25  # pixels: focal length · baseline / depth
