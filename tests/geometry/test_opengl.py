import roma
import torch

from extrap_train.geometry.foreign_cameras import opengl_from_world_to_cam, world_to_cam_from_opengl


def test_a_camera_at_the_origin_looks_down_minus_z_with_y_up():
    world_to_cam = world_to_cam_from_opengl(torch.eye(4))
    right_above_ahead = torch.tensor([1.0, 2, -3, 1])
    assert (world_to_cam @ right_above_ahead).tolist() == [1, -2, 3, 1]


def test_the_camera_stays_where_it_is():
    cam_to_world = torch.eye(4)
    cam_to_world[:3, :3] = roma.euler_to_rotmat("x", [90], degrees=True)
    cam_to_world[:3, 3] = torch.tensor([1.0, 2, 3])
    center = torch.linalg.inv(world_to_cam_from_opengl(cam_to_world))[:3, 3]
    torch.testing.assert_close(center, torch.tensor([1.0, 2, 3]))


def test_there_and_back():
    torch.manual_seed(0)
    cam_to_world = roma.Rigid(roma.random_rotmat(7).double(), torch.randn(7, 3).double())
    matrices = cam_to_world.to_homogeneous()
    again = opengl_from_world_to_cam(world_to_cam_from_opengl(matrices))
    torch.testing.assert_close(again, matrices)
