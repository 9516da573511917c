"""The 19 numbers, computed by hand for simple poses."""

import math

import torch

from extrap_train.diffusion.pose_encoding import depth_scale, zeronvs_pose
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
                depth_scale(depth * unit),
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
    torch.testing.assert_close(depth_scale(depth), torch.tensor([3.0, 1.0]))
