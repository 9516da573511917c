from dataclasses import replace

import pytest
import torch
from oracle import exact_pair
from traced_scenes import SCENES, orbit_camera, render

from extrap_train.depth.mast3r.known_cameras import pair_scale, posed_depths, predicted_pose
from extrap_train.depth.mast3r.network.point_map_network import PredictedPoints

SCENE = SCENES["box on the ground"]
FIRST, SECOND = orbit_camera(0, 64), orbit_camera(25, 64)


def worst_error(found, unit: float = 1.0) -> float:
    """Relative, over every pixel of both views."""
    pairs = zip(found, (FIRST, SECOND), strict=True)
    errors = [(d.depth / render(SCENE, c).depth - 1).abs().max() for d, c in pairs]
    return float(max(errors))


@pytest.mark.parametrize("unit", [1.0, 0.05, 40.0])
def test_scale_comes_from_the_baseline_whatever_the_networks_unit(unit):
    """1: a metric network in a metric world. Others: metres in a world of another unit, or points
    that are only right up to scale."""
    found = posed_depths(*exact_pair(SCENE, FIRST, SECOND, unit), FIRST, SECOND)
    assert worst_error(found) < 1e-3
    assert all(torch.allclose(d.confidence, torch.tensor(0.8)) for d in found)


def test_either_view_may_be_the_first():
    found = posed_depths(*exact_pair(SCENE, SECOND, FIRST, 3.0), SECOND, FIRST)
    assert worst_error(found[::-1]) < 1e-3


def test_noise_and_gross_errors_in_a_third_of_the_points_change_little():
    generator = torch.Generator().manual_seed(0)
    first, second = exact_pair(SCENE, FIRST, SECOND, 2.0)

    def spoilt(prediction: PredictedPoints) -> PredictedPoints:
        points = prediction.points
        points = points * (1 + 0.01 * torch.randn(points.shape, generator=generator))
        wild = torch.rand(points.shape[:-1], generator=generator) < 0.3
        gross = 3 * torch.rand(points.shape, generator=generator) - 1
        return replace(prediction, points=torch.where(wild[..., None], gross, points))

    found = posed_depths(spoilt(first), spoilt(second), FIRST, SECOND)
    ratios = [d.depth / render(SCENE, c).depth for d, c in zip(found, (FIRST, SECOND), strict=True)]
    assert all(abs(float(ratio.median()) - 1) < 0.02 for ratio in ratios)


def test_the_predicted_camera_is_the_one_that_sees_the_points():
    _, second = exact_pair(SCENE, FIRST, SECOND, 1.0)
    found = predicted_pose(second.points[0], torch.ones(64, 64), SECOND)
    expected = SECOND.world_to_cam @ FIRST.cam_to_world
    torch.testing.assert_close(found.float(), expected, atol=1e-4, rtol=1e-4)
    assert predicted_pose(torch.rand(64, 64, 3), torch.ones(64, 64), SECOND) is None
    assert predicted_pose(torch.zeros(64, 64, 3), torch.ones(64, 64), SECOND) is None


def test_no_scale_without_parallax_or_against_the_known_cameras():
    known = (SECOND.world_to_cam @ FIRST.cam_to_world).double()
    turned = (orbit_camera(-25, 64).world_to_cam @ FIRST.cam_to_world).double()
    still = torch.eye(4, dtype=torch.float64)
    assert pair_scale(known, known, 2.0) == pytest.approx(1)
    assert pair_scale(turned, known, 2.0) is None
    assert pair_scale(still, known, 2.0) is None
    assert pair_scale(known, still, 2.0) is None
    assert posed_depths(*exact_pair(SCENE, FIRST, FIRST, 1.0), FIRST, FIRST) is None
