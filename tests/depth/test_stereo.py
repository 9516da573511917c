import pytest
import torch
from traced_scenes import SCENES, orbit_camera, render

from extrap_train.config import StereoConfig
from extrap_train.depth.stereo import PlaneSweepStereo
from extrap_train.errors import InputError
from extrap_train.geometry.cameras import unproject_to_world
from extrap_train.views import View

STEREO = PlaneSweepStereo(StereoConfig(image_size=160))


def three_views(scene: str, size: int = 160) -> list[View]:
    """15° apart, each exposed differently, with sensor noise."""
    return [
        render(SCENES[scene], orbit_camera(azimuth_deg, size), gain, noise=0.01)
        for azimuth_deg, gain in ((0, 1.0), (-15, 0.8), (15, 1.1))
    ]


@pytest.mark.parametrize("scene", SCENES)
def test_depth_of_textured_scenes(scene):
    view, *neighbours = three_views(scene)
    found = STEREO.depth_map(view, neighbours)
    error = (found.depth / view.depth - 1).abs()
    assert error.median() <= 0.01
    assert (error <= 0.03).float().mean() >= 0.8

    half = found.confidence.flatten().argsort(descending=True)[: error.numel() // 2]
    assert error.flatten()[half].mean() <= error.mean() / 2
    reliable = found.reliable() > 0
    assert (error[reliable] <= 0.03).float().mean() >= 0.97
    assert reliable.float().mean() >= 0.85


def test_the_sequence_at_once_is_as_good():
    views = three_views("box on the ground")
    found = STEREO.depth_maps(views)
    for view, depth_map in zip(views, found, strict=True):
        error = (depth_map.reliable() / view.depth - 1).abs()[depth_map.reliable() > 0]
        assert error.median() <= 0.01


def test_point_maps_lie_on_the_surface_in_the_first_frame():
    first, second, _ = three_views("sphere on the ground")
    maps = STEREO.point_maps(first, second)
    for points, confidence, view in (
        (maps.first, maps.first_confidence, first),
        (maps.second, maps.second_confidence, second),
    ):
        truth = unproject_to_world(view.depth, view.camera)
        world = points @ first.camera.cam_to_world[:3, :3].mT + first.camera.center
        distance = (world - truth).norm(dim=-1)[confidence > 0.3]
        assert distance.median() <= 0.02


def test_the_map_has_the_size_of_the_photograph():
    view, *neighbours = three_views("slanted plane", size=200)
    found = PlaneSweepStereo(StereoConfig(image_size=100)).depth_map(view, neighbours)
    assert found.depth.shape == found.confidence.shape == (200, 200)
    assert (found.depth / view.depth - 1).abs().median() <= 0.01


def test_nothing_is_sure_without_texture():
    views = [
        View(torch.full((3, 96, 96), 0.5), orbit_camera(azimuth_deg, 96))
        for azimuth_deg in (0, -15, 15)
    ]
    assert not STEREO.depth_map(views[0], views[1:]).reliable().any()


def test_the_same_place_twice_tells_no_depth():
    first, second, _ = three_views("slanted plane", size=64)
    again = View(first.image, first.camera, name="again.jpg")
    with pytest.raises(InputError, match=r"again\.jpg.*depth=dataset"):
        STEREO.depth_map(again, [first])
    for found in STEREO.depth_maps([first, again]):
        assert not found.depth.any()
        assert not found.confidence.any()
    assert STEREO.depth_map(again, [first, second]).reliable().any()


def test_repeatable():
    views = three_views("box on the ground", size=80)
    once, again = (STEREO.depth_map(views[0], views[1:]) for _ in range(2))
    assert torch.equal(once.depth, again.depth)
    assert torch.equal(once.confidence, again.confidence)
