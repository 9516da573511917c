"""Triangulated points lie on the surface, and come from the views that are given and no others."""

import numpy as np
import pytest
import torch

from extrap_train.gaussians.init import Points, projection_matrices, triangulate, triangulate_points
from extrap_train.geometry.cameras import project
from extrap_train.views import View
from tests.scenes import orbit_camera as analytic_camera
from tests.traced_scenes import SCENES, orbit_camera, render


@pytest.fixture(scope="module")
def views() -> list[View]:
    scene = SCENES["sphere on the ground"]
    return [render(scene, orbit_camera(azimuth, 160)) for azimuth in (0.0, 10.0, 20.0)]


@pytest.fixture(scope="module")
def points(views: list[View]) -> Points:
    return triangulate_points(views)


def test_points_lie_on_the_surface(views, points):
    assert len(points) > 60
    pixels, depth = project(points.positions, views[1].camera)
    column, row = pixels.long().clamp(0, 159).unbind(-1)
    truth = views[1].depth[row, column]
    assert (depth / truth - 1).abs().median() < 0.01
    # at depth edges the pixel's depth is another surface's
    assert ((depth / truth - 1).abs() < 0.05).float().mean() > 0.9


def test_points_have_the_colour_of_their_pixels(views, points):
    pixels, _ = project(points.positions, views[0].camera)
    column, row = pixels.long().clamp(0, 159).unbind(-1)
    seen = views[0].image[:, row, column].T
    assert (seen - points.colors).abs().mean(1).median() < 0.06


def test_a_textureless_scene_has_no_points(views):
    grey = [View(torch.full_like(view.image, 0.5), view.camera) for view in views]
    assert len(triangulate_points(grey)) == 0


def test_exact_pixels_give_the_exact_point():
    cameras = [analytic_camera(azimuth) for azimuth in (0, 25, 60)]
    point = torch.tensor([[0.2, -0.1, 0.15]])
    pixels = np.stack([project(point, camera)[0][0].double().numpy() for camera in cameras])
    found = triangulate(pixels, projection_matrices(cameras))
    np.testing.assert_allclose(found, point[0].numpy(), atol=1e-5)


def test_noise_costs_no_more_than_any_small_step_would_gain():
    """Gauss-Newton ends where the reprojection error has its minimum."""
    cameras = [analytic_camera(azimuth) for azimuth in (0, 25, 60)]
    projections = projection_matrices(cameras)
    rng = np.random.default_rng(0)
    truth = np.array([0.2, -0.1, 0.15])

    def error(point: np.ndarray) -> float:
        cam = projections @ np.append(point, 1)
        return float(np.square(cam[:, :2] / cam[:, 2:] - pixels).sum())

    exact = projections @ np.append(truth, 1)
    pixels = exact[:, :2] / exact[:, 2:] + rng.normal(0, 0.5, (3, 2))
    found = triangulate(pixels, projections)
    assert all(error(found) <= error(found + 1e-3 * rng.normal(size=3)) for _ in range(50))
