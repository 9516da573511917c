"""A crop or a resize shows what a camera with the new intrinsics sees: scenes rendered twice."""

from dataclasses import replace

import pytest
import torch
from scenes import Scene, orbit_camera, plane

from extrap_train.views import Camera, View, stack_cameras


@pytest.fixture(scope="module")
def view() -> View:
    # Tilted down onto the plane alone, so that no edge blurs; taller than wide and off-centre.
    camera = replace(orbit_camera(20, elevation_deg=60, size=96), height=120)
    scene = Scene((plane(0.5, (0.0, 1.0, 0.0)),))
    depth = scene.depth(camera)
    return View(scene.image(camera), camera, depth, (depth > 3).float(), "a")


def seen_by(camera: Camera) -> View:
    scene = Scene((plane(0.5, (0.0, 1.0, 0.0)),))
    return View(scene.image(camera), camera, scene.depth(camera))


def test_a_crop_is_what_the_cropped_camera_sees(view):
    crop = view.cropped(7, 13, 40, 50)
    expected = seen_by(crop.camera)
    assert crop.image.shape == (3, 40, 50)
    torch.testing.assert_close(crop.image, expected.image, rtol=0, atol=1e-5)
    torch.testing.assert_close(crop.depth, expected.depth)
    assert crop.mask.shape == (40, 50)
    assert crop.name == "a"


@pytest.mark.parametrize("size", [(60, 48), (40, 32), (240, 192), (77, 53)])
def test_a_resized_view_is_what_the_resized_camera_sees(view, size):
    resized = view.resized(*size)
    expected = seen_by(resized.camera)
    inner = (..., slice(2, -2), slice(2, -2))
    # Half a pixel of shift would cost more than 0.01 on average.
    assert (resized.image - expected.image)[inner].abs().mean() < 2e-3
    relative = (resized.depth / expected.depth - 1)[inner]
    # A quarter of a pixel of shift, which the nearest pixel costs at half the size, is 3e-3.
    assert relative.abs().max() < 1e-3


def test_squared_is_the_centred_square(view):
    square = view.squared(64)
    assert square.image.shape == (3, 64, 64)
    k = square.camera.intrinsics
    assert (k[0, 2].item(), k[1, 2].item()) == pytest.approx((32, (48 - 12) * 64 / 96))
    assert (square.image - seen_by(square.camera).image)[:, 2:-2, 2:-2].abs().mean() < 2e-3


def test_crop_and_resize_commute_with_the_cameras(view):
    again = view.camera.cropped(10, 20, 30, 40).resized(60, 80)
    other = view.camera.resized(240, 192).cropped(20, 40, 60, 80)
    torch.testing.assert_close(again.intrinsics, other.intrinsics)


def test_a_crop_beyond_the_image_is_refused(view):
    with pytest.raises(ValueError, match="leaves the"):
        view.cropped(100, 0, 40, 40)


@pytest.mark.parametrize("size", [(32, 32), (40, 40), (100, 90)])
def test_depth_edges_stay_edges(size):
    camera = orbit_camera(0, size=64)
    depth = torch.full((64, 64), 5.0)
    depth[10:37, 21:50] = 2  # a card before a wall
    depth[50:53] = 0  # and unknown there
    resized = View(torch.zeros(3, 64, 64), camera, depth).resized(*size).depth
    off = (resized[..., None] - torch.tensor([0.0, 2.0, 5.0])).abs().amin(-1)
    assert (off <= 0.02 * resized).all()


def test_only_cameras_of_one_size_can_be_stacked():
    cameras = [orbit_camera(azimuth, size=64) for azimuth in (0, 30, 60)]
    batch = stack_cameras(cameras)
    torch.testing.assert_close(batch[1].world_to_cam, cameras[1].world_to_cam)
    with pytest.raises(ValueError, match="cannot be stacked"):
        stack_cameras([cameras[0], cameras[1].resized(32, 32)])
