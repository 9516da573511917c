"""What no scene can be completed from is refused in one line; units and origins do not matter."""

from dataclasses import replace

import numpy as np
import pytest
import scenes
import torch
from orbits import even, ring

from extrap_train.data.camera_check import (
    ROLLED,
    TRANSPOSED,
    quaternions_rolled,
    rotations_transposed,
)
from extrap_train.data.sequences import Frame
from extrap_train.depth import DatasetDepth
from extrap_train.errors import InputError
from extrap_train.geometry.viewpoints import scene_center
from extrap_train.reconstruction.capture_check import check_poses
from extrap_train.reconstruction.inputs import (
    check_cameras,
    choose_frames,
    first_views,
    fit_world_frame,
    stand_where,
)
from extrap_train.views import Camera, View, stack_cameras

NAMES = ["a", "b", "c"]


def cameras(*azimuths_deg: float, size: int = 48) -> list[Camera]:
    return [scenes.orbit_camera(a, size=size) for a in azimuths_deg]


def test_three_sound_views_pass():
    check_cameras(cameras(-30, 0, 30), NAMES)


def test_a_single_view_is_refused():
    with pytest.raises(InputError, match="give at least two"):
        check_cameras(cameras(0), ["a"])


def test_two_identical_poses_are_refused():
    with pytest.raises(InputError, match="a and c stand in the same place"):
        check_cameras(cameras(0, 30, 0), NAMES)


def test_which_cameras_stand_where_another_does():
    others = stack_cameras(cameras(-30, 0, 0.2, 30))
    nearer = scenes.orbit_camera(0)
    center = scene_center(others)
    assert stand_where(nearer, others, center).tolist() == [False, True, True, False]


def test_views_that_see_nothing_in_common_are_refused():
    away = scenes.orbit_camera(20)
    turned = away.world_to_cam.clone()
    turned[:3, :3] = torch.diag(torch.tensor([-1.0, 1.0, -1.0])) @ turned[:3, :3]
    turned[:3, 3] = -turned[:3, :3] @ away.center
    with pytest.raises(InputError, match="see nothing in common"):
        check_cameras([*cameras(-30, 0), replace(away, world_to_cam=turned)], NAMES)


def bumpy(camera: Camera) -> View:
    """A view of a plane with corners to match: blocks of random grey in space."""
    origins, directions = scenes.rays(camera)
    points = origins + directions * scenes.PLANE.hit(origins, directions)[:, None]
    cell = (points * 12).floor().long()
    grey = ((cell[:, 0] * 73856093) ^ (cell[:, 1] * 19349663)).remainder(97) / 97
    return View(grey.float().reshape(1, camera.height, camera.width).expand(3, -1, -1), camera)


@pytest.mark.parametrize(
    ("signs", "name"),
    [((1.0, -1.0, -1.0), "OpenGL axes"), ((-1.0, -1.0, 1.0), "PyTorch3D axes")],
)
def test_a_wrong_axis_convention_is_named(signs, name):
    # Cameras that only turn around the vertical keep their epipolar lines under some flips.
    poses = [(-15, 0.0), (0, 25.0), (12, 5.0)]
    views = [bumpy(scenes.orbit_camera(a, elevation_deg=e, size=256)) for a, e in poses]
    check_poses(views)
    flip = torch.diag(torch.tensor([*signs, 1.0]))
    wrong = [
        replace(v, camera=replace(v.camera, world_to_cam=flip @ v.camera.world_to_cam))
        for v in views
    ]
    with pytest.raises(InputError, match=rf"poses contradict the photographs.*{name}"):
        check_poses(wrong)


@pytest.mark.parametrize(
    ("misread", "name"),
    [
        # The inverse of a roll by one place is one by three.
        (lambda m: quaternions_rolled(quaternions_rolled(quaternions_rolled(m))), ROLLED),
        (rotations_transposed, TRANSPOSED),  # its own inverse
    ],
)
def test_rotations_read_in_another_order_are_named(misread, name):
    poses = [(40, 10.0), (50, 30.0), (60, 15.0)]
    views = [bumpy(scenes.orbit_camera(a, elevation_deg=e, size=256)) for a, e in poses]
    wrong = [
        replace(v, camera=replace(v.camera, world_to_cam=misread(v.camera.world_to_cam)))
        for v in views
    ]
    with pytest.raises(InputError, match=rf"poses contradict the photographs.*{name}"):
        check_poses(wrong)


@pytest.mark.parametrize("unit", [1e-4, 1e4])
def test_unit_and_origin_of_the_world_do_not_matter(unit):
    views = [
        View(scenes.SPHERE_ON_PLANE.image(c), c, scenes.SPHERE_ON_PLANE.depth(c))
        for c in cameras(-30, 0, 30)
    ]
    scaled = [replace(v, camera=scenes.scaled(v.camera, unit), depth=v.depth * unit) for v in views]
    found = []
    for group in (views, scaled):
        world = fit_world_frame(stack_cameras([v.camera for v in group]))
        inside, _ = first_views(group, DatasetDepth(), world, 32)
        found.append(inside)
        back = world.outside(inside[0].camera)
        assert torch.allclose(
            back.center / unit if group is scaled else back.center,
            views[0].camera.center,
            atol=1e-4,
        )
        points = world.points_outside(inside[0].camera.center[None])
        assert torch.allclose(points[0], back.center, rtol=1e-4)
    for one, other in zip(*found, strict=True):
        assert torch.allclose(one.depth, other.depth, rtol=1e-4)
        assert torch.allclose(one.camera.world_to_cam, other.camera.world_to_cam, atol=1e-5)
        assert float(one.camera.center.norm()) == pytest.approx(1, rel=0.2)


def test_depth_with_holes_over_half_the_picture_is_continued_with_low_confidence():
    views = []
    for camera in cameras(-30, 0, 30):
        depth = scenes.PLANE.depth(camera)
        depth[:, ::2] = 0
        depth[:8] = 0
        views.append(View(scenes.PLANE.image(camera), camera, depth))
    world = fit_world_frame(stack_cameras([v.camera for v in views]))
    inside, confidences = first_views(views, DatasetDepth(), world, 48)
    for view, confidence in zip(inside, confidences, strict=True):
        truth = scenes.PLANE.depth(world.outside(view.camera)) / world.unit
        assert (view.depth > 0).float().mean() > 0.9
        assert ((view.depth / truth - 1).abs()[8:] < 0.03).all()
        assert (confidence[:, ::2] < 0.3).all()


def test_no_depth_at_all_is_refused():
    views = [View(scenes.PLANE.image(c), c, torch.zeros(48, 48)) for c in cameras(-30, 0, 30)]
    world = fit_world_frame(stack_cameras([v.camera for v in views]))
    with pytest.raises(InputError, match="no reliable depth in any photograph"):
        first_views(views, DatasetDepth(), world, 32)


def frames(count: int) -> list[Frame]:
    cams = ring(even(count))
    return [Frame(f"f{i}", cams[i], True, False, lambda depth: None, ()) for i in range(count)]


def test_one_sided_inputs_are_neighbours_and_spread_ones_are_not():
    whole = frames(24)
    cams = ring(even(24))
    center = scene_center(cams)
    for draw, least, most in (("one_sided", 40, 80), ("spread", 150, 260)):
        chosen = choose_frames(whole, 3, [], draw, 0)
        azimuths = np.degrees(np.sort([2 * np.pi * i / 24 for i in chosen]))
        gaps = np.diff([*azimuths, azimuths[0] + 360])
        assert least <= 360 - gaps.max() <= most
    assert np.linalg.norm(center - [0.5, -0.2, 0.1]) < 1e-3


def test_where_every_walk_has_a_gap_the_smallest_gap_is_taken():
    cams = ring(np.array([0.0, 20.0, 150.0, 175.0, 260.0]))
    found = [Frame(f"f{i}", cams[i], True, False, lambda depth: None, ()) for i in range(5)]
    for seed in range(4):
        assert choose_frames(found, 4, [], "one_sided", seed) in ([2, 3, 4, 0], [3, 2, 4, 0])


def test_more_inputs_than_there_are_frames_are_refused():
    assert choose_frames(frames(5), 5, [], "one_sided", 0) == [0, 1, 2, 3, 4]
    with pytest.raises(InputError, match="inputs=6"):
        choose_frames(frames(5), 6, [], "one_sided", 0)


def test_names_of_inputs_are_taken_as_they_are_and_unknown_ones_refused():
    assert choose_frames(frames(5), 3, ["f4", "f1"], "one_sided", 0) == [4, 1]
    with pytest.raises(InputError, match="has no frame f9"):
        choose_frames(frames(5), 3, ["f9"], "one_sided", 0)
