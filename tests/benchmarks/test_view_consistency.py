"""Consistency is measured against exact geometry: true views agree, moved ones do not."""

import math

import numpy as np
import pytest
import torch

from benchmarks.score.view_consistency import (
    neighbour_pairs,
    symmetric_epipolar_distance,
    tsed,
    warp_psnr,
)
from extrap_train.geometry.cameras import transform
from extrap_train.geometry.epipolar import fundamental_matrix
from extrap_train.views import Camera, stack_cameras
from tests.benchmarks.analytic import view_at
from tests.scenes import orbit_camera


def _projected(points: np.ndarray, camera: Camera) -> np.ndarray:
    cam = transform(camera.world_to_cam.double(), torch.from_numpy(points))
    pixel = (cam @ camera.intrinsics.double().T).numpy()
    return pixel[:, :2] / pixel[:, 2:]


def test_true_matches_lie_on_their_lines_and_shifted_ones_do_not() -> None:
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (40, 3))
    one, two = orbit_camera(0, size=256), orbit_camera(25, size=256)
    a, b = _projected(points, one), _projected(points, two)
    fundamental = fundamental_matrix(one, two)
    assert symmetric_epipolar_distance(a, b, fundamental).max() < 1e-3
    shifted = symmetric_epipolar_distance(a, b + np.array([0.0, 5.0]), fundamental)
    assert 2 < np.median(shifted) <= 5


def test_the_epipolar_distance_is_the_mean_of_both_ways() -> None:
    """A pure sideways move: epipolar lines are rows, so a vertical error e counts e both ways."""
    one = orbit_camera(0, size=128)
    moved = one.world_to_cam.clone()
    moved[0, 3] -= 0.3
    two = Camera(moved, one.intrinsics, 128, 128)
    a = np.array([[40.0, 60.0]])
    np.testing.assert_allclose(
        symmetric_epipolar_distance(a, a + np.array([[-9.0, 3.0]]), fundamental_matrix(one, two)),
        3.0,
        atol=1e-4,
    )


def test_neighbours_are_the_nearest_by_angle() -> None:
    cameras = stack_cameras([orbit_camera(a) for a in (0, 10, 90, 105)])
    assert neighbour_pairs(cameras) == [(0, 1), (2, 3)]


@pytest.fixture(scope="module")
def textured() -> tuple[torch.Tensor, Camera]:
    """Photographs of a plane with a random texture, from two sides: SIFT finds plenty."""
    rng = np.random.default_rng(1)
    texture = torch.from_numpy(rng.uniform(size=(1, 3, 40, 40))).float()
    texture = torch.nn.functional.interpolate(texture, (256, 256), mode="bicubic").clamp(0, 1)
    images, cameras = [], []
    for azimuth in (-8.0, 8.0):
        camera = orbit_camera(azimuth, distance=2.0, elevation_deg=0.0, size=128)
        # Where each pixel's ray meets the plane z = 0, which the texture covers over [-1, 1]².
        from tests.scenes import rays

        origin, direction = rays(camera)
        point = origin - direction * (origin[:, 2:] / direction[:, 2:])
        grid = point[:, :2].reshape(1, 128, 128, 2).float()
        images.append(torch.nn.functional.grid_sample(texture, grid, align_corners=False)[0])
        cameras.append(camera)
    return torch.stack(images).clamp(0, 1), stack_cameras(cameras)


def test_tsed_tells_true_poses_from_wrong_ones(textured: tuple[torch.Tensor, Camera]) -> None:
    images, cameras = textured
    assert tsed(images, cameras) == 1
    # A vertical shift of the picture, 8 px at the 256² that TSED looks at, breaks the geometry.
    shifted = torch.stack([images[0], images[1].roll(4, dims=1)])
    assert tsed(shifted, cameras) == 0
    blank = torch.full_like(images, 0.5)
    assert tsed(blank, cameras) == 0
    assert math.isnan(tsed(images[:1], cameras[torch.tensor([0])]))


def test_true_views_agree_better_than_moved_ones() -> None:
    views = [view_at(a, 48) for a in (0.0, 15.0)]
    images = torch.stack([v.image for v in views])
    depths = torch.stack([v.depth for v in views if v.depth is not None])
    cameras = stack_cameras([v.camera for v in views])
    floor = warp_psnr(images, depths, cameras)
    assert floor > 25
    assert warp_psnr(images.roll(3, dims=-1), depths, cameras) < floor - 3


@pytest.mark.parametrize(("angle_deg", "is_empty"), [(60.0, False), (180.0, True)])
def test_views_from_opposite_sides_say_nothing(angle_deg: float, is_empty: bool) -> None:
    """By the true depths: what one sees lies behind the ball, or the camera, of the other."""
    views = [view_at(a, 32) for a in (0.0, angle_deg)]
    images = torch.stack([v.image for v in views])
    depths = torch.stack([v.depth for v in views if v.depth is not None])
    assert len(depths) == 2
    cameras = stack_cameras([v.camera for v in views])
    assert math.isnan(warp_psnr(images, depths, cameras)) == is_empty
