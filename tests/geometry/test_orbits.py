"""Cameras between the views of a circle are those of the circle."""

import numpy as np
import pytest
import torch
from orbits import even, ring

from extrap_train.geometry.viewpoints import camera_centers, facing, fit_orbit_of_few, orbit_cameras
from extrap_train.views import Camera


@pytest.mark.parametrize("inputs", [[0, 1, 2], [0, 4, 8], [3, 5, 9, 10]])
def test_a_full_turn_goes_through_the_views_that_it_was_fitted_to(inputs):
    views = ring(even(12))
    made = orbit_cameras(views[torch.tensor(inputs)], 2 * np.pi, 12)
    order = [inputs[0] + step for step in range(12)]
    if np.linalg.norm(camera_centers(made)[1] - camera_centers(views)[(inputs[0] + 1) % 12]) > 1:
        order = [inputs[0] - step for step in range(12)]
    expected = views[torch.tensor([i % 12 for i in order])]
    torch.testing.assert_close(made.world_to_cam, expected.world_to_cam, atol=1e-4, rtol=0)
    torch.testing.assert_close(made.intrinsics, expected.intrinsics)


def test_a_part_of_a_turn_starts_at_the_first_view_and_keeps_its_distance():
    views = ring(np.array([10.0, 50.0, 90.0]), elevation_deg=35)
    made = orbit_cameras(views, np.pi / 2, 3)
    torch.testing.assert_close(made.world_to_cam[0], views.world_to_cam[0], atol=1e-4, rtol=0)
    distance = np.linalg.norm(camera_centers(made) - [0.5, -0.2, 0.1], axis=1)
    np.testing.assert_allclose(distance, 3.0, rtol=1e-5)


def test_two_views_are_no_orbit():
    with pytest.raises(ValueError, match="an orbit needs 3 views, not 2"):
        orbit_cameras(ring(even(4))[:2], np.pi, 3)


def test_cameras_on_a_circle_are_found_where_they_were_put():
    circle = fit_orbit_of_few(ring(even(7), elevation_deg=20))
    azimuths, elevations = np.radians([10, 100, 350]), np.radians([-5, 0, 40])
    distances = np.array([1.0, 2.0, 3.0])
    poses = torch.from_numpy(circle.poses(azimuths, elevations, distances))
    cameras = Camera(poses, torch.eye(3).double().expand(3, 3, 3), 8, 8)
    for found, given in zip(
        circle.locate(camera_centers(cameras)), (azimuths, elevations, distances), strict=True
    ):
        np.testing.assert_allclose(found, given, atol=1e-9)
    assert facing(cameras, circle.center, 1e-6).all()
    up = -cameras.world_to_cam[:, 1, :3].numpy()
    assert (up @ circle.axis > 0).all()


def test_a_circle_starts_at_its_first_view_and_leans_as_its_views_do():
    views = ring(even(5), elevation_deg=20)
    circle = fit_orbit_of_few(views)
    azimuths, elevations, distances = circle.locate(camera_centers(views))
    assert np.abs(np.angle(np.exp(1j * azimuths[0]))) < 1e-6
    np.testing.assert_allclose(circle.axis, [0, 0, 1], atol=1e-5)
    np.testing.assert_allclose(elevations, np.radians(20), atol=1e-5)
    np.testing.assert_allclose(distances, 3, rtol=1e-5)


@pytest.mark.parametrize("span_deg", [360, 75])
@pytest.mark.parametrize("turns", [(1, 1, 1, 1, 1), (1, -1, -1, 1, 1)])
def test_photographs_on_their_side_go_around_the_same_axis(span_deg, turns):
    views = ring(even(5, span_deg), elevation_deg=20)
    on_side = views.world_to_cam.clone()
    for matrix, turn in zip(on_side, turns, strict=True):
        right, down = matrix[0].clone(), matrix[1].clone()
        matrix[0], matrix[1] = turn * down, -turn * right
    circle = fit_orbit_of_few(Camera(on_side, views.intrinsics, views.height, views.width))
    np.testing.assert_allclose(np.abs(circle.axis), [0, 0, 1], atol=1e-5)
