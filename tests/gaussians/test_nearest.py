"""Where nothing can stand, told from the inputs' cameras."""

import math
from dataclasses import replace

import pytest
import torch

from benchmarks.methods.dngaussian import DnGaussian
from extrap_train.gaussians.density import GrowthStatistics
from extrap_train.gaussians.gaussian_options import Schedule
from extrap_train.gaussians.init import (
    Points,
    nearest_expected,
    parameters_from_points,
    random_points,
)
from extrap_train.gaussians.optimiser import GaussianOptimiser
from extrap_train.gaussians.recipe import Training
from extrap_train.gaussians.training_scene import training_scene
from extrap_train.geometry.cameras import project
from extrap_train.views import Camera
from tests.benchmarks.analytic import scene_inputs
from tests.scenes import orbit_camera

RATES = dict.fromkeys(("means", "log_scales", "quats", "opacity_logits", "sh_dc", "sh_rest"), 0.0)


def _cropped(camera: Camera, left: int, top: int, width: int, height: int) -> Camera:
    intrinsics = camera.intrinsics.clone()
    intrinsics[:2, 2] -= torch.tensor([left, top], dtype=intrinsics.dtype)
    return replace(camera, intrinsics=intrinsics, width=width, height=height)


def test_an_object_begins_where_the_ball_that_its_camera_sees_whole_does():
    """The ball's outline touches the picture's border, and its front is what comes back."""
    cameras = [orbit_camera(a, distance=d) for a, d in ((0, 1.0), (120, 1.2), (240, 0.8))]
    for camera, nearest in zip(cameras, nearest_expected(cameras), strict=True):
        distance = float(camera.center.norm())
        radius = distance - float(nearest)
        tangent = math.sqrt(distance**2 - radius**2)
        outline = torch.tensor([[tangent * radius / distance, 0.0, tangent**2 / distance]])
        world = (outline - camera.world_to_cam[:3, 3]) @ camera.world_to_cam[:3, :3]
        pixel, _ = project(world, camera)
        assert float(pixel[0, 0]) == pytest.approx(camera.width, abs=1e-2)


def test_the_lesser_side_of_a_crop_decides_wherever_it_was_cut():
    whole = [orbit_camera(a, distance=1.0, size=128) for a in (0, 120)]
    middle = [_cropped(camera, 0, 32, 128, 64) for camera in whole]
    assert (nearest_expected(middle) > nearest_expected(whole) + 0.1).all()
    aside = [_cropped(camera, 0, 48, 128, 64) for camera in whole]
    torch.testing.assert_close(nearest_expected(aside), nearest_expected(middle), atol=0.03, rtol=0)


def test_nothing_is_told_by_inputs_that_do_not_look_at_one_thing():
    cameras = [orbit_camera(a, distance=1.0) for a in (0, 120)]
    past = [*cameras, _cropped(orbit_camera(240, distance=1.0), 80, 0, 48, 128)]
    assert not nearest_expected(past).any()
    away = cameras[0].world_to_cam.clone()
    away[2, 3] = -1.0  # the origin is behind it
    assert not nearest_expected([cameras[1], replace(cameras[0], world_to_cam=away)]).any()
    assert (nearest_expected(cameras) > 0.5).all()


def test_random_points_start_where_something_may_be():
    cameras = [orbit_camera(a, distance=1.0) for a in (0, 120, 240)]
    points = random_points(cameras[:1], 500, torch.Generator().manual_seed(0))
    depth = project(points.positions, cameras[0])[1]
    nearest = float(nearest_expected(cameras[:1])[0])
    assert nearest <= float(depth.min()) < nearest + 0.1


def _left_of(positions: torch.Tensor) -> torch.Tensor:
    """What DNGaussian's clearing leaves of tiny Gaussians at these places of the frame."""
    inputs, _ = scene_inputs(size=32)
    scene = training_scene(inputs.views, inputs.depth_source, seed=0)
    options = DnGaussian(iterations=100, full_iterations=100, densify_until=0)
    recipe = options.recipe(options, scene)
    count = len(positions)
    points = Points(positions, torch.rand(count, 3), torch.ones(count))
    training = Training(
        GaussianOptimiser(parameters_from_points(points, 0, 0.5, widest=0.01), RATES),
        GrowthStatistics.empty(positions),
        Schedule(100, 100),
        recipe.generator,
        iteration=26,
    )
    recipe.adapt(training)
    assert len(training.statistics.visits) == len(training.optimiser)
    return training.optimiser.parameters.means.detach()


def test_what_stands_right_before_an_input_or_where_none_looks_is_cleared_away():
    eye = scene_inputs(size=32)[0].views[1].camera.center / 3
    origin, aside, behind = torch.zeros(3), torch.tensor([0.1, 0.0, 0.1]), 30 * eye
    left = _left_of(torch.stack([origin, 0.7 * eye, aside, behind, 0.2 * eye]))
    torch.testing.assert_close(left, torch.stack([origin, aside, 0.2 * eye]))


def test_clearing_never_takes_all():
    eye = scene_inputs(size=32)[0].views[1].camera.center / 3
    assert len(_left_of(torch.stack([0.7 * eye, 0.8 * eye]))) == 1
