"""What a better view shows already is left out."""

import torch

from benchmarks.methods.instantsplat import nearest_depth, unique_pixels
from extrap_train.depth import DepthMap
from extrap_train.views import View
from tests.scenes import CARD_AND_PLANE, SPHERE_ON_PLANE, Scene, orbit_camera


def _views(scene: Scene, azimuths: list[float]) -> tuple[list[View], list[DepthMap]]:
    cameras = [orbit_camera(azimuth, size=48) for azimuth in azimuths]
    views = [View(scene.image(camera), camera, scene.depth(camera)) for camera in cameras]
    maps = [DepthMap(v.depth, (v.depth > 0).float()) for v in views]
    return views, maps


def test_the_same_view_twice_is_kept_once():
    views, maps = _views(SPHERE_ON_PLANE, [0.0, 0.0])
    first, second = unique_pixels(views, maps, 0.01)
    assert first.equal(views[0].depth > 0)
    assert not second.any()


def test_only_what_the_first_does_not_see_is_kept_of_the_second():
    views, maps = _views(CARD_AND_PLANE, [0.0, 30.0])
    maps[1] = DepthMap(maps[1].depth, 0.5 * maps[1].confidence)
    first, second = unique_pixels(views, maps, 0.02)
    assert first.equal(views[0].depth > 0)
    seen = CARD_AND_PLANE.visible_from(views[0].camera, views[1].camera)
    known = views[1].depth > 0
    assert second[known & ~seen].float().mean() > 0.9
    assert second[seen].float().mean() < 0.3


def test_the_surer_view_comes_first_wherever_it_stands():
    views, maps = _views(SPHERE_ON_PLANE, [0.0, 0.0])
    maps[0] = DepthMap(maps[0].depth, 0.5 * maps[0].confidence)
    first, second = unique_pixels(views, maps, 0.01)
    assert not first.any()
    assert second.equal(views[1].depth > 0)


def test_the_nearest_point_of_a_pixel_counts():
    camera = orbit_camera(0.0, size=8)
    forward = camera.forward
    points = torch.stack([camera.center + 2.5 * forward, camera.center + 1.5 * forward])
    depth = nearest_depth(points, camera)
    assert (depth > 0).sum() == 1
    torch.testing.assert_close(depth.max(), torch.tensor(1.5))
