"""Pose corrections, the motion of a whole rig, and cameras between the inputs."""

import math

import torch

from benchmarks.methods.fsgs import pseudo_camera
from benchmarks.methods.instantsplat import (
    PoseCorrections,
    similarity_between,
)
from extrap_train.geometry.cameras import project
from extrap_train.views import Camera
from tests.scenes import orbit_camera


def test_no_correction_at_the_start_and_rigid_ever_after():
    corrections = PoseCorrections(2)
    camera = orbit_camera(30.0)
    torch.testing.assert_close(corrections.corrected(camera, 1).world_to_cam, camera.world_to_cam)
    with torch.no_grad():
        corrections.quats[1] = torch.tensor([2.0, 0.1, 0.3, -0.2])
        corrections.translations[1] = torch.tensor([0.1, 0.2, 0.3])
    moved = corrections.corrected(camera, 1).world_to_cam
    rotation = moved[:3, :3]
    torch.testing.assert_close(rotation @ rotation.T, torch.eye(3), atol=1e-5, rtol=0)
    assert torch.det(rotation) > 0
    torch.testing.assert_close(corrections.corrected(camera, 0).world_to_cam, camera.world_to_cam)


def _moved(camera: Camera, rotation: torch.Tensor, shift: torch.Tensor, scale: float) -> Camera:
    """The camera that sees `scale · rotation · x + shift` where the given one sees x."""
    world_to_cam = torch.eye(4)
    world_to_cam[:3, :3] = camera.world_to_cam[:3, :3] @ rotation.T
    center = scale * rotation @ camera.center + shift
    world_to_cam[:3, 3] = -world_to_cam[:3, :3] @ center
    return Camera(world_to_cam, camera.intrinsics, camera.height, camera.width)


def test_the_motion_of_a_rig_is_found_also_for_views_in_a_row():
    angle = torch.tensor(0.3)
    rotation = torch.eye(3)
    rotation[:2, :2] = torch.tensor([[angle.cos(), -angle.sin()], [angle.sin(), angle.cos()]])
    shift, scale = torch.tensor([0.5, -0.2, 0.1]), 1.7
    in_a_row = [orbit_camera(0.0) for _ in range(3)]
    for step, camera in enumerate(in_a_row):
        camera.world_to_cam[0, 3] += 0.3 * step
    for given in ([orbit_camera(a) for a in (0, 50, 100)], in_a_row):
        refined = [_moved(camera, rotation, shift, scale) for camera in given]
        found = similarity_between(given, refined)
        torch.testing.assert_close(found.rotation, rotation, atol=1e-5, rtol=0)
        torch.testing.assert_close(found.translation, shift, atol=1e-4, rtol=0)
        assert abs(found.scale - scale) < 1e-4


def test_a_moved_camera_sees_the_moved_points_where_it_saw_them_before():
    given = [orbit_camera(a) for a in (0, 50, 100)]
    rotation = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    shift = torch.tensor([0.5, -0.2, 0.1])
    found = similarity_between(given, [_moved(c, rotation, shift, 2.0) for c in given])
    target = orbit_camera(200.0)
    points = torch.tensor([[0.1, 0.2, 0.3], [-0.2, 0.1, 0.0]])
    seen, _ = project(points, target)
    after, _ = project(2.0 * points @ rotation.T + shift, found.camera(target))
    torch.testing.assert_close(after, seen, atol=1e-2, rtol=0)
    batch = Camera(target.world_to_cam[None], target.intrinsics[None], 128, 128)
    torch.testing.assert_close(
        found.camera(batch).world_to_cam[0], found.camera(target).world_to_cam
    )


def test_pseudo_cameras_stand_between_two_inputs_and_look_at_the_scene():
    cameras = [orbit_camera(a, distance=1.0) for a in (0, 40, 180)]
    generator = torch.Generator().manual_seed(0)
    for _ in range(20):
        camera = pseudo_camera(cameras, generator, jitter=0.0)
        rotation = camera.world_to_cam[:3, :3]
        torch.testing.assert_close(rotation @ rotation.T, torch.eye(3), atol=1e-5, rtol=0)
        assert abs(float(camera.center.norm()) - 1) < 1e-4
        toward = -camera.center / camera.center.norm()
        # the chord of 40° keeps the optical axis within a few degrees of the centre
        between = [float(toward @ each.forward) for each in cameras[:2]]
        if min(between) > math.cos(math.radians(41)):
            assert float(camera.forward @ toward) > math.cos(math.radians(5))
