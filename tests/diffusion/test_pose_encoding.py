"""The 19 numbers, computed by hand for simple poses."""

import math
from collections.abc import Callable

import pytest
import torch

from extrap_train.diffusion.pose_encoding import depth_scale, megascenes_pose, zeronvs_pose
from extrap_train.views import Camera

_INTRINSICS = torch.tensor([[[50.0, 0, 32], [0, 100, 32], [0, 0, 1]]])


def test_a_step_to_the_right_and_back() -> None:
    """The query stands 2 right of and 1 behind the reference: +x and, in OpenGL, +z."""
    reference = Camera(torch.eye(4)[None], _INTRINSICS, 64, 64)
    query_world_to_cam = torch.eye(4)[None].clone()
    query_world_to_cam[0, :3, 3] = torch.tensor([-2.0, 0, 1.0])
    query = Camera(query_world_to_cam, _INTRINSICS, 64, 64)
    numbers = zeronvs_pose(reference, query, torch.tensor([4.0]))[0]
    x, z = 5 * math.tanh(0.05), 5 * math.tanh(0.025)
    fov = 2 * math.atan(0.32)  # the smaller: 64 pixels high at a focal length of 100
    expected = [1, 0, 0, x, 0, 1, 0, 0, 0, 0, 1, z, 0, 0, 0, 1, fov, math.sin(fov), math.cos(fov)]
    torch.testing.assert_close(numbers, torch.tensor(expected), atol=1e-6, rtol=0)


def test_a_quarter_turn_to_the_left() -> None:
    """Turning left about the vertical is +90° about y in both OpenGL and, seen from above, the
    world.
    """
    reference = Camera(torch.eye(4)[None], _INTRINSICS, 64, 64)
    # OpenCV: after a left turn, forward is −x of the reference, right is +z.
    turned = torch.tensor([[[0.0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]]])
    numbers = zeronvs_pose(reference, Camera(turned, _INTRINSICS, 64, 64), torch.ones(1))[0]
    rotation = numbers[:16].view(4, 4)[:3, :3]
    expected = torch.tensor([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])  # rotation by +90° about +y
    torch.testing.assert_close(rotation, expected)


def test_the_encoding_does_not_depend_on_the_unit() -> None:
    depth = torch.rand(1, 16, 16) + 1
    query = torch.eye(4)[None].clone()
    query[0, :3, 3] = torch.tensor([0.3, -0.2, 0.5])
    encodings = []
    for unit in (1.0, 1000.0):
        scaled = query.clone()
        scaled[0, :3, 3] *= unit
        encodings.append(
            zeronvs_pose(
                Camera(torch.eye(4)[None], _INTRINSICS, 16, 16),
                Camera(scaled, _INTRINSICS, 16, 16),
                depth_scale(depth * unit, every=4, least=1e-2),
            )
        )
    torch.testing.assert_close(encodings[0], encodings[1])


def test_half_precision_around_it_changes_nothing() -> None:
    """A metre apart, a kilometre from the world's origin: bfloat16 would lose the metre."""
    reference, query = torch.eye(4)[None].clone(), torch.eye(4)[None].clone()
    reference[0, 0, 3], query[0, 0, 3] = 1000.0, 1001.0
    cameras = [Camera(matrix, _INTRINSICS, 64, 64) for matrix in (reference, query)]
    exact = zeronvs_pose(*cameras, torch.ones(1))
    with torch.autocast("cpu", torch.bfloat16):
        torch.testing.assert_close(zeronvs_pose(*cameras, torch.ones(1)), exact, atol=0, rtol=0)


def test_scale_ignores_unknown_depth_and_survives_its_absence() -> None:
    depth = torch.zeros(2, 8, 8)
    depth[0, ::8, ::8] = 3.0
    scale = depth_scale(depth, every=4, least=1e-2)
    torch.testing.assert_close(scale, torch.tensor([3.0, 1.0]))
    torch.testing.assert_close(depth_scale(depth * 1e-9, 1, 1e-7)[0], torch.tensor(1e-7))


def test_megascenes_keeps_axes_and_translation() -> None:
    """The query stands 2 right of and 1 behind the reference: +x and, in OpenCV, −z."""
    reference = Camera(torch.eye(4)[None], _INTRINSICS, 64, 48)
    query_world_to_cam = torch.eye(4)[None].clone()
    query_world_to_cam[0, :3, 3] = torch.tensor([-2.0, 0, 1.0])
    query = Camera(query_world_to_cam, _INTRINSICS, 64, 48)
    numbers = megascenes_pose(reference, query, torch.tensor([4.0]))[0]
    fov = 2 * math.atan(80 / (2 * 50))  # 64 by 48 pixels are 80 along the diagonal
    expected = [1, 0, 0, 0.5, 0, 1, 0, 0, 0, 0, 1, -0.25, 0, 0, 0, 1]
    expected += [fov, math.sin(fov), math.cos(fov)]
    torch.testing.assert_close(numbers, torch.tensor(expected), atol=1e-6, rtol=0)


def test_megascenes_turns_the_other_way_about_the_vertical() -> None:
    """A left turn is −90° about OpenCV's y, which points down."""
    reference = Camera(torch.eye(4)[None], _INTRINSICS, 64, 64)
    turned = torch.tensor([[[0.0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]]])
    numbers = megascenes_pose(reference, Camera(turned, _INTRINSICS, 64, 64), torch.ones(1))[0]
    rotation = numbers[:16].view(4, 4)[:3, :3]
    expected = torch.tensor([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]])
    torch.testing.assert_close(rotation, expected)


@pytest.mark.parametrize("pose", [zeronvs_pose, megascenes_pose])
def test_a_resized_view_has_the_same_pose_and_a_cropped_one_another_field_of_view(
    pose: Callable[..., torch.Tensor],
) -> None:
    """512-pixel cameras need no conversion: the field of view is read from the camera itself."""
    intrinsics = torch.tensor([[[600.0, 0, 256], [0, 600, 256], [0, 0, 1]]])
    camera = Camera(torch.eye(4)[None], intrinsics, 512, 512)
    whole = pose(camera, camera, torch.ones(1))
    torch.testing.assert_close(pose(camera, camera.resized(256, 256), torch.ones(1)), whole)
    narrow = pose(camera, camera.cropped(128, 128, 256, 256), torch.ones(1))
    assert narrow[0, 16] < whole[0, 16] - 0.2
    torch.testing.assert_close(narrow[0, :16], whole[0, :16])
