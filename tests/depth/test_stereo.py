import logging
from dataclasses import replace

import pytest
import torch
from traced_scenes import SCENES, orbit_camera, render

from extrap_train.config import StereoConfig
from extrap_train.depth import NoDepthError
from extrap_train.depth.stereo import PlaneSweepStereo
from extrap_train.errors import InputError
from extrap_train.geometry.cameras import unproject_to_world
from extrap_train.views import Camera, View

STEREO = PlaneSweepStereo(StereoConfig(image_size=128))


def three_views(scene: str, size: int = 128) -> list[View]:
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


def test_every_view_of_a_sequence_has_its_depth():
    views = three_views("box on the ground", size=96)
    for view, found in zip(views, STEREO.depth_maps(views), strict=True):
        error = (found.reliable() / view.depth - 1).abs()[found.reliable() > 0]
        assert error.median() <= 0.01


def test_one_view_has_the_depth_that_it_has_in_its_sequence():
    views = three_views("box on the ground", size=48)
    alone, together = STEREO.depth_map(views[0], views[1:]), STEREO.depth_maps(views)[0]
    assert torch.equal(alone.depth, together.depth)
    assert torch.equal(alone.confidence, together.confidence)


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
    view, *neighbours = three_views("slanted plane", size=120)
    found = PlaneSweepStereo(StereoConfig(image_size=80)).depth_map(view, neighbours)
    assert found.depth.shape == found.confidence.shape == (120, 120)
    assert (found.depth / view.depth - 1).abs().median() <= 0.01


def test_nothing_is_sure_without_texture():
    views = [
        View(torch.full((3, 40, 40), 0.5), orbit_camera(azimuth_deg, 40))
        for azimuth_deg in (0, -15, 15)
    ]
    assert not STEREO.depth_map(views[0], views[1:]).reliable().any()


def test_the_same_place_twice_tells_no_depth():
    first, second, _ = three_views("slanted plane", size=48)
    again = View(first.image, first.camera, name="again.jpg")
    with pytest.raises(InputError, match=r"again\.jpg.*depth=dataset"):
        STEREO.depth_map(again, [first])
    with pytest.raises(NoDepthError, match=r"again\.jpg.*depth=dataset"):
        STEREO.depth_maps([first, again])
    assert STEREO.depth_map(again, [first, second]).reliable().any()


def test_repeatable():
    views = three_views("box on the ground", size=40)
    once, again = (STEREO.depth_map(views[0], views[1:]) for _ in range(2))
    assert torch.equal(once.depth, again.depth)
    assert torch.equal(once.confidence, again.confidence)


def small_views(*azimuths_deg: float) -> list[View]:
    scene = SCENES["sphere on the ground"]
    return [
        replace(
            render(scene, orbit_camera(a, 32), 1.0, noise=0.01), name=f"at{a:03.0f}", depth=None
        )
        for a in azimuths_deg
    ]


@pytest.mark.parametrize("azimuths_deg", [(0,), (0, 60), (0, 120, 240), (0, 90, 180, 270)])
def test_views_too_far_apart_are_the_cause_that_is_named(azimuths_deg):
    views = small_views(*azimuths_deg)
    with pytest.raises(NoDepthError) as caught:
        STEREO.depth_maps(views)
    message = str(caught.value)
    assert "\n" not in message
    assert all(view.name in message for view in views)
    assert "45°" in message
    assert "input_frames=" in message


@pytest.mark.parametrize(
    ("azimuths_deg", "alone"),
    [
        ((0, 20, 100), ["at100"]),
        ((0, 80, 95, 175), ["at000", "at175"]),
        ((0, 1, 30, 120), ["at120"]),
    ],
)
def test_views_without_a_neighbour_are_named_once(azimuths_deg, alone, caplog):
    views = small_views(*azimuths_deg)
    with caplog.at_level(logging.WARNING):
        found = STEREO.depth_maps(views)
    (message,) = [r.getMessage() for r in caplog.records if "45°" in r.getMessage()]
    for view, depth in zip(views, found, strict=True):
        assert (view.name in message) == (view.name in alone)
        assert bool(depth.confidence.any()) == (view.name not in alone)


def test_views_that_are_sure_nowhere_are_named(caplog):
    views = small_views(0, 15)
    views.append(replace(small_views(-15)[0], image=torch.full((3, 32, 32), 0.5), name="blank"))
    with caplog.at_level(logging.WARNING):
        STEREO.depth_maps(views)
    (record,) = caplog.records
    assert "blank" in record.getMessage()
    assert "at000" not in record.getMessage()


def _moved(camera: Camera, world_to_cam: torch.Tensor) -> Camera:
    return replace(camera, world_to_cam=world_to_cam)


def _inverted(camera: Camera, index: int) -> Camera:
    return _moved(camera, camera.cam_to_world)


def _rounded(camera: Camera, index: int) -> Camera:
    return _moved(camera, (camera.cam_to_world * 1e7).round() / 1e7)


def _on_a_tripod(camera: Camera, index: int) -> Camera:
    rotation = camera.world_to_cam[:3, :3]
    moved = camera.world_to_cam.clone()
    moved[:3, 3] = -rotation @ torch.tensor([1.0, 2.0, 3.0])
    return _moved(camera, moved)


@pytest.mark.parametrize("change", [_inverted, _rounded, _on_a_tripod])
def test_cameras_in_one_place_are_the_cause_that_is_named(change):
    views = [
        replace(view, camera=change(view.camera, index))
        for index, view in enumerate(small_views(*range(0, 360, 30)))
    ]
    with pytest.raises(NoDepthError, match="one place"):
        STEREO.depth_maps(views)


def test_neighbours_that_see_nothing_are_no_traceback():
    """Back to back: no plane in front of one camera moves in the other's picture."""
    first, second = small_views(0, 20)
    turned = torch.diag(torch.tensor([-1.0, 1, -1, 1])) @ second.camera.world_to_cam
    second = replace(second, camera=_moved(second.camera, turned))
    for found in STEREO.depth_maps([first, second]):
        assert not found.reliable().any()
