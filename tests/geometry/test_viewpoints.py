import numpy as np
import pytest
import roma
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from orbits import even, looking_at, ring

from extrap_train.geometry.viewpoints import (
    camera_centers,
    extra_references,
    facing,
    farthest_point_sample,
    fit_orbit,
    pairwise_angles,
    references_by_nearness,
    scene_center,
)
from extrap_train.views import Camera


def moved(camera: Camera, seed: int, scale: float) -> tuple[Camera, np.ndarray, np.ndarray]:
    """The same cameras in another world: turned, scaled, shifted."""
    torch.manual_seed(seed)
    rotation = roma.random_rotmat(dtype=torch.float64)
    shift = torch.randn(3, dtype=torch.float64)
    world = camera.world_to_cam.double()
    turned = world.clone()
    turned[:, :3, :3] = world[:, :3, :3] @ rotation.T
    turned[:, :3, 3] = world[:, :3, 3] * scale - turned[:, :3, :3] @ shift
    new = Camera(turned.float(), camera.intrinsics, camera.height, camera.width)
    return new, rotation.numpy(), shift.numpy()


def test_optical_axes_that_meet_give_their_meeting_point() -> None:
    camera = ring(even(7, 200), center=(1.0, 2.0, -3.0))
    np.testing.assert_allclose(scene_center(camera), [1, 2, -3], atol=1e-5)


def test_the_center_is_the_least_squares_point() -> None:
    rng = np.random.default_rng(0)
    camera = looking_at(rng.normal(size=(6, 3)) * 4, np.zeros(3))
    camera.world_to_cam[:, :3, 3] += torch.tensor(rng.normal(size=(6, 3)) * 0.1)
    origins, forward = camera_centers(camera), camera.forward.double().numpy()

    def cost(point: np.ndarray) -> float:
        return float((np.linalg.norm(np.cross(point - origins, forward), axis=1) ** 2).sum())

    center = scene_center(camera)
    nudges = np.concatenate([np.eye(3), -np.eye(3)]) * 1e-3
    assert all(cost(center) < cost(center + nudge) for nudge in nudges)


def test_parallel_axes_give_a_center_that_nobody_faces() -> None:
    positions = np.stack([np.arange(5.0), np.zeros(5), np.zeros(5)], 1)
    camera = looking_at(positions, np.array([0.0, 1e9, 0.0]))
    center = scene_center(camera)
    assert np.isfinite(center).all()
    assert not facing(camera, center, np.radians(60)).any()


def test_cameras_that_look_outwards_do_not_face_their_center() -> None:
    camera = ring(even(12), elevation_deg=0)
    camera.world_to_cam[:, [0, 2]] *= -1  # half a turn about the image's up
    assert not facing(camera, scene_center(camera), np.radians(60)).any()


def test_angles_of_a_level_ring_are_its_azimuth_differences() -> None:
    camera = ring(np.array([0.0, 30.0, 90.0, 180.0]), elevation_deg=0)
    angles = np.degrees(pairwise_angles(camera, scene_center(camera)))
    np.testing.assert_allclose(angles[0], [0, 30, 90, 180], atol=1e-3)
    np.testing.assert_allclose(angles, angles.T)


@given(st.integers(0, 99), st.floats(0, 60), st.floats(0.01, 1e4), st.floats(100, 720))
@settings(max_examples=25, deadline=None)
def test_an_orbit_is_found_in_any_world(
    seed: int, elevation: float, scale: float, span: float
) -> None:
    azimuths = even(40, span)
    camera, rotation, shift = moved(ring(azimuths, elevation), seed, scale)
    orbit = fit_orbit(camera)
    np.testing.assert_allclose(orbit.axis, rotation @ [0, 0, 1], atol=2e-3)
    expected = rotation @ np.array([0.5, -0.2, 0.1]) * scale + shift
    np.testing.assert_allclose(orbit.center, expected, atol=1e-3 * scale + 1e-3)
    azimuths_rad, elevations_rad, _ = orbit.locate(camera_centers(camera))
    np.testing.assert_allclose(np.degrees(elevations_rad), elevation, atol=0.5)
    steps = np.degrees(np.unwrap(azimuths_rad))
    np.testing.assert_allclose(np.abs(steps - steps[0]), azimuths, atol=0.5)


def test_an_elliptical_tilted_orbit_keeps_its_axis() -> None:
    radius = 1 / np.sqrt(np.cos(np.radians(even(48))) ** 2 / 9 + np.sin(np.radians(even(48))) ** 2)
    camera, rotation, _ = moved(ring(even(48), 25, radius), 3, 1.0)
    assert np.degrees(np.arccos(fit_orbit(camera).axis @ rotation @ [0, 0, 1])) < 1


def test_nearly_collinear_positions_have_a_finite_orbit() -> None:
    positions = np.stack([np.linspace(-1, 1, 9), np.full(9, -3.0), np.zeros(9)], 1)
    cameras = looking_at(positions, np.zeros(3))
    orbit = fit_orbit(cameras)
    assert np.isfinite(orbit.locate(camera_centers(cameras))[0]).all()
    assert abs(orbit.axis[2]) > 0.99


def test_extra_references_spread_out() -> None:
    camera = ring(even(36))
    angles = pairwise_angles(camera, scene_center(camera))
    rng = np.random.default_rng(0)
    draws = [extra_references(angles, 0, 3, 2, rng, np.arange(36))[0] for _ in range(300)]
    near = np.mean([angles[3, frame] < np.radians(30) for frame in draws])
    assert near < 0.05 < 5 / 33  # a uniform draw would be near in five of 33 cases


def test_farthest_points_of_a_line() -> None:
    positions = np.array([[0.0], [1.0], [4.0], [9.0], [10.0]])
    assert farthest_point_sample(positions, 4, start=0).tolist() == [0, 4, 2, 1]
    assert farthest_point_sample(np.zeros((3, 2)), 3).tolist() == [0, 1, 2]
    with pytest.raises(ValueError, match="cannot choose 6 of 5"):
        farthest_point_sample(positions, 6)


def test_the_nearest_view_of_a_camera_is_itself_however_its_directions_are_rounded() -> None:
    """The cosine of a direction with itself may come out above 1, which no angle has."""
    cameras = ring(np.random.default_rng(0).uniform(0, 360, 300))
    order = references_by_nearness(cameras, cameras)
    assert np.array_equal(order[:, 0], np.arange(300))
