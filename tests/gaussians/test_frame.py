"""The frame is a similarity, found from the input cameras alone."""

import pytest
import torch

from extrap_train.errors import InputError
from extrap_train.gaussians.training_scene import scene_frame
from extrap_train.geometry.cameras import project
from extrap_train.views import Camera
from tests.scenes import orbit_camera, scaled


def test_the_frame_puts_the_orbit_at_distance_one_around_the_origin():
    frame = scene_frame([orbit_camera(a, distance=3.0) for a in (0, 70, 200)])
    torch.testing.assert_close(frame.center, torch.zeros(3), atol=1e-5, rtol=0)
    assert frame.unit == pytest.approx(3.0, rel=1e-5)
    for azimuth in (0, 70, 123):
        moved = frame.inside(orbit_camera(azimuth, distance=3.0))
        assert float(moved.center.norm()) == pytest.approx(1.0, rel=1e-4)


@pytest.mark.parametrize("unit", [1e-4, 1.0, 1e4])
def test_a_point_is_seen_at_the_same_pixel_in_any_unit(unit):
    cameras = [scaled(orbit_camera(a), unit) for a in (0, 40, 100)]
    frame = scene_frame(cameras)
    points = torch.tensor([[0.1, 0.2, -0.05], [-0.2, 0.0, 0.3]])
    for camera in cameras:
        pixels, depth = project(frame.points_outside(points), camera)
        inside, normalised = project(points, frame.inside(camera))
        torch.testing.assert_close(pixels, inside, atol=1e-2, rtol=0)
        torch.testing.assert_close(depth / frame.unit, normalised, atol=1e-4, rtol=1e-4)


def test_cameras_that_look_the_same_way_still_have_a_frame():
    cameras = [Camera(torch.eye(4), torch.eye(3), 8, 8) for _ in range(2)]
    cameras[1].world_to_cam[0, 3] = -4.0
    frame = scene_frame(cameras)
    torch.testing.assert_close(frame.center, torch.tensor([2.0, 0.0, 0.0]))
    assert frame.unit == pytest.approx(2.0)


def test_cameras_at_one_place_are_refused():
    with pytest.raises(InputError, match="one place"):
        scene_frame([orbit_camera(10.0), orbit_camera(10.0)])
