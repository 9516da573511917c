"""Poses in another convention are found by what the cameras of a capture look at together."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scenes import orbit_camera

from extrap_train.data.camera_check import (
    CO3D_POSES,
    COLMAP_POSES,
    OPENGL_POSES,
    find_pose_fault,
    fits_photograph,
    require_sound,
)
from extrap_train.errors import InputError
from extrap_train.geometry.foreign_cameras import (
    camera_from_viewpoint,
    colmap_from_world_to_cam,
    opengl_from_world_to_cam,
    rigid_inverse,
    viewpoint_from_camera,
    world_to_cam_from_colmap,
    world_to_cam_from_opengl,
)
from extrap_train.views import Camera, stack_cameras


def orbit(count=8, arc_deg=360.0, elevation_deg=20.0) -> Camera:
    return stack_cameras(
        [orbit_camera(arc_deg * i / count, elevation_deg=elevation_deg) for i in range(count)]
    )


def shifted(cameras: Camera, offset) -> Camera:
    matrices = cameras.world_to_cam.clone()
    matrices[:, :3, 3] -= matrices[:, :3, :3] @ torch.tensor(offset)
    return replace(cameras, world_to_cam=matrices)


def looking(places, targets) -> Camera:
    """Cameras at some places that look at others, upright."""
    matrices = []
    for place, target in zip(np.asarray(places, float), np.asarray(targets, float), strict=True):
        forward = (target - place) / np.linalg.norm(target - place)
        right = np.cross([0, 1.0, 0], forward)
        right /= np.linalg.norm(right)
        matrix = np.eye(4)
        matrix[:3, :3] = right, np.cross(forward, right), forward
        matrix[:3, 3] = -matrix[:3, :3] @ place
        matrices.append(torch.tensor(matrix).float())
    intrinsics = torch.eye(3).expand(len(matrices), 3, 3)
    return Camera(torch.stack(matrices), intrinsics, 8, 8)


ROW = np.stack([np.linspace(-1, 1, 6), np.zeros(6), np.zeros(6)], 1)
AHEAD = np.array([0, 0, 5.0])
SOUND = {
    "circle": orbit(),
    "steep circle": orbit(elevation_deg=80),
    "arc": orbit(6, 60),
    "few": orbit(3, 90),
    "away from the origin": shifted(orbit(), [3.0, 1.0, 20.0]),
    "one": orbit(1),
    "row that looks ahead": looking(ROW, ROW + AHEAD),
    "row that looks apart a little": looking(ROW, ROW * 1.5 + AHEAD),
    "one stray": looking([*orbit(7).center.numpy(), [0, 0, 3]], [*np.zeros((7, 3)), [0.1, 0, 9]]),
}


@pytest.mark.parametrize("convention", [OPENGL_POSES, COLMAP_POSES, CO3D_POSES])
@pytest.mark.parametrize("name", SOUND)
def test_sound_captures_pass(name, convention):
    assert find_pose_fault(SOUND[name], convention) == ""


MISREAD = {
    # What is read where the matrices are of another convention than OpenGL's camera-to-world.
    "camera-to-world in OpenCV's axes": lambda true: world_to_cam_from_opengl(rigid_inverse(true)),
    "world-to-camera in OpenCV's axes": world_to_cam_from_opengl,
    "world-to-camera in OpenGL's axes": lambda true: world_to_cam_from_opengl(
        rigid_inverse(opengl_from_world_to_cam(true))
    ),
}


@pytest.mark.parametrize("said", MISREAD)
@pytest.mark.parametrize("name", ["circle", "arc", "away from the origin"])
def test_other_conventions_are_named(name, said):
    misread = replace(SOUND[name], world_to_cam=MISREAD[said](SOUND[name].world_to_cam))
    fault = find_pose_fault(misread, OPENGL_POSES)
    assert "camera-to-world in OpenGL's axes (+X right, +Y up, −Z forward)" in fault
    assert f"look as if they were {said.split(' in ')[0]}" in fault


def test_models_with_the_inverse_poses_are_named():
    misread = replace(orbit(), world_to_cam=rigid_inverse(orbit().world_to_cam))
    assert "as if they were camera-to-world" in find_pose_fault(misread, COLMAP_POSES)


def test_quaternions_in_another_order_are_named():
    true = SOUND["away from the origin"]  # around the origin, any rotation looks at it
    wxyz, translation = colmap_from_world_to_cam(true.world_to_cam)
    misread = world_to_cam_from_colmap(wxyz.roll(-1, dims=-1), translation)
    fault = find_pose_fault(replace(true, world_to_cam=misread), COLMAP_POSES)
    assert "as if they were quaternions in the order x, y, z, w" in fault


def test_rotations_of_pytorch3d_that_are_transposed_are_named():
    true = viewpoint_from_camera(SOUND["away from the origin"])
    read = camera_from_viewpoint(replace(true, rotation=true.rotation.mT), 64, 64)
    assert "with R transposed" in find_pose_fault(read, CO3D_POSES)


@pytest.mark.parametrize(
    ("linear", "cause"),
    [
        (np.diag([1, -1, 1]), "mirrored"),
        (np.diag([1, 1.02, 1]), "scaled unevenly"),
        (np.diag([np.nan, 1, 1]), "NaN"),
    ],
)
def test_what_makes_a_pose_degenerate_is_named(linear, cause):
    camera = with_lens(96, 96, 90, 90, 48, 48)
    matrix = camera.world_to_cam.clone()
    matrix[:3, :3] = matrix[:3, :3] @ torch.tensor(linear, dtype=torch.float32)
    with pytest.raises(InputError, match=cause):
        require_sound(replace(camera, world_to_cam=matrix), "one.png", Path("cameras.json"))


@pytest.mark.parametrize(
    ("name", "cameras"),
    [
        ("tripod", looking(np.zeros((8, 3)), SOUND["circle"].center.numpy())),
        ("tripod afar", shifted(looking(np.zeros((8, 3)), orbit().center.numpy()), [0.0, 0, 50])),
        ("map", shifted(orbit(), [4e6, 3e5, 0.0])),
        ("rounded", replace(orbit(), world_to_cam=torch.eye(4).repeat(8, 1, 1))),
    ],
)
def test_cameras_in_one_place_are_refused(name, cameras):
    assert "in one place" in find_pose_fault(cameras, OPENGL_POSES), name


@pytest.mark.parametrize("convention", [OPENGL_POSES, COLMAP_POSES, CO3D_POSES])
def test_cameras_that_look_apart_are_refused(convention):
    away = orbit().center.numpy()
    assert "nothing in common" in find_pose_fault(looking(away, 3 * away), convention)


def with_lens(width: int, height: int, fx: float, fy: float, cx: float, cy: float) -> Camera:
    intrinsics = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float32)
    return replace(orbit_camera(0), intrinsics=intrinsics, width=width, height=height)


def with_angle(width: int, height: int, angle_deg: float) -> Camera:
    focal = width / 2 / np.tan(np.radians(angle_deg) / 2)
    return with_lens(width, height, focal, focal, width / 2, height / 2)


PHOTOGRAPHS = {
    "telephoto": with_angle(4000, 3000, 5),
    "upright telephoto": with_angle(3000, 4000, 5),
    "action camera": with_angle(1920, 1080, 122),
    "circular fisheye": with_lens(1920, 1080, 1080 / 3.4, 1080 / 3.4, 960, 540),
    "panorama": with_lens(4000, 1000, 900, 900, 2000, 500),
    "shifted lens": with_lens(640, 480, 600, 600, 240, 300),
}


@pytest.mark.parametrize("name", PHOTOGRAPHS)
def test_lenses_of_photographs_pass(name):
    assert fits_photograph(PHOTOGRAPHS[name])
    require_sound(PHOTOGRAPHS[name], name, Path("cameras.json"))


@pytest.mark.parametrize(
    ("camera", "cause"),
    [
        (with_lens(96, 96, 1.17, 1.17, 0.5, 0.5), "normalised"),
        (with_lens(96, 96, 1.17, 1.17, 48, 48), "normalised"),
        (with_lens(640, 480, 600, 600, 0.5, 0.5), "normalised"),
        (with_lens(96, 96, 112, 112, 0, 0), "another size"),
        (with_lens(24, 24, 60, 60, 24, 24), "another size"),
        (with_angle(96, 96, 0.81), "x_fov in degrees"),
        (with_angle(96, 96, np.degrees(2.5)), "camera_angle_x is in radians"),
    ],
)
def test_lenses_that_fit_no_photograph_are_refused_with_the_likely_cause(camera, cause):
    assert not fits_photograph(camera)
    with pytest.raises(InputError, match=cause) as caught:
        require_sound(camera, "one.png", Path("cameras.json"))
    assert str(caught.value).startswith("cameras.json: one.png: ")
    assert "\n" not in str(caught.value)
