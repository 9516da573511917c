import pytest
import roma
import torch

from extrap_train.geometry.cameras import (
    coordinate_grid,
    pixel_grid,
    project,
    unproject,
    unproject_to_world,
)
from extrap_train.views import Camera


def camera(batch=(), seed=0):
    torch.manual_seed(seed)
    rotation = roma.random_rotmat(batch, dtype=torch.float64)
    pose = roma.Rigid(rotation, torch.randn(*batch, 3).double())
    intrinsics = torch.tensor([[50.0, 0, 15.5], [0, 60, 11], [0, 0, 1]]).double()
    return Camera(pose.to_homogeneous(), intrinsics.expand(*batch, 3, 3).clone(), 24, 32)


def test_the_principal_ray_meets_the_principal_point():
    straight = Camera(torch.eye(4), torch.tensor([[50.0, 0, 16], [0, 60, 12], [0, 0, 1]]), 24, 32)
    pixel, depth = project(torch.tensor([[0.0, 0, 7], [1, -1, 2]]), straight)
    assert pixel.tolist() == [[16, 12], [41, -18]]
    assert depth.tolist() == [7, 2]


def test_pixel_centres_lie_at_one_half():
    grid = pixel_grid(2, 3)
    assert grid[0, 0].tolist() == [0.5, 0.5]
    assert grid[1, 2].tolist() == [2.5, 1.5]


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_unprojected_pixels_project_onto_themselves(batch):
    cameras = camera(batch)
    depth = torch.rand(*batch, 24, 32).double() + 0.5
    world = unproject_to_world(depth, cameras)
    pixel, again = project(world.flatten(-3, -2), cameras)
    expected = pixel_grid(24, 32).double().flatten(0, 1).expand_as(pixel)
    torch.testing.assert_close(pixel, expected)
    torch.testing.assert_close(again, depth.flatten(-2))


def test_depth_is_z_and_not_the_length_of_the_ray():
    points = unproject(torch.full((24, 32), 3.0).double(), camera())
    assert (points[..., 2] == 3).all()


def test_center_and_forward():
    one = camera()
    torch.testing.assert_close(one.cam_to_world, torch.linalg.inv(one.world_to_cam))
    ahead = one.center + 2 * one.forward
    pixel, depth = project(ahead[None], one)
    torch.testing.assert_close(pixel[0], one.intrinsics[:2, 2])
    assert depth.item() == pytest.approx(2)


def test_grid_has_normalised_pixel_centres():
    grid = coordinate_grid(2, 4)
    assert torch.allclose(grid[0, 0], torch.tensor([-0.75, -0.25, 0.25, 0.75]))
    assert torch.allclose(grid[1, :, 0], torch.tensor([-0.5, 0.5]))
