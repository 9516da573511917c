import numpy as np
import torch
from scenes import orbit_camera

from extrap_train.geometry.cameras import project, transform
from extrap_train.geometry.epipolar import (
    epipolar_directions,
    epipolar_distance,
    epipolar_lines,
    fundamental_matrix,
    homogeneous,
    steps_across,
)
from extrap_train.views import Camera


def points_at(camera: Camera, depth: torch.Tensor, count: int = 200) -> torch.Tensor:
    """World points behind random pixels of `camera`."""
    pixels = torch.rand(count, 2, generator=torch.Generator().manual_seed(0)) * camera.width
    rays = torch.cat([pixels, torch.ones(count, 1)], 1) @ torch.linalg.inv(camera.intrinsics).mT
    return transform(camera.cam_to_world, rays * depth)


def test_wrong_depths_move_points_along_and_never_across():
    reference, query = orbit_camera(0, size=128), orbit_camera(35, size=128)
    depth = 2 + torch.rand(200, 1, generator=torch.Generator().manual_seed(1))
    right, wrong = (project(points_at(reference, depth * factor), query)[0] for factor in (1, 1.07))
    moved = wrong - right
    assert moved.norm(dim=1).median() > 1
    assert steps_across(right, moved, reference, query).max() < 1e-3
    along = (moved * epipolar_directions(right, reference, query)).sum(1).abs()
    assert torch.allclose(along, moved.norm(dim=1), atol=1e-3)


def test_what_leaves_a_line_is_its_distance_from_the_fundamental_matrix_line():
    reference, query = orbit_camera(10, size=96), orbit_camera(60, size=96)
    generator = torch.Generator().manual_seed(2)
    first = torch.rand(50, 2, generator=generator) * 96
    homogeneous = np.concatenate([first.double().numpy(), np.ones((50, 1))], 1)
    lines = homogeneous @ fundamental_matrix(reference, query).T
    normals = lines[:, :2] / np.linalg.norm(lines[:, :2], axis=1, keepdims=True)
    feet = -lines[:, 2:] / np.linalg.norm(lines[:, :2], axis=1, keepdims=True) * normals
    steps = torch.randn(50, 2, generator=generator) * 4
    found = steps_across(torch.from_numpy(feet).float(), steps, reference, query)
    np.testing.assert_allclose(found, np.abs((steps.numpy() * normals).sum(1)), atol=1e-2)


def test_cameras_side_by_side_have_rows_for_lines_and_one_camera_has_none():
    reference = orbit_camera(0, size=64)
    sideways = reference.world_to_cam.clone()
    sideways[0, 3] -= 0.5
    query = Camera(sideways, reference.intrinsics, 64, 64)
    pixels, steps = torch.tensor([[3.0, 50.0], [40.0, 7.0]]), torch.tensor([[5.0, 2.0], [0.0, -3]])
    across = steps_across(pixels, steps, reference, query)
    assert torch.allclose(across, torch.tensor([2.0, 3.0]), atol=1e-4)
    assert not epipolar_directions(pixels, query, query).isnan().any()


def test_distances_from_epipolar_lines_are_those_of_exact_projections():
    first, second = orbit_camera(0, size=128), orbit_camera(35, size=128)
    points = torch.tensor([[0.1, 0.2, 0.3], [-0.3, 0.1, 0.0]])
    a, b = (project(points, camera)[0].double().numpy() for camera in (first, second))
    fundamental = fundamental_matrix(first, second)
    np.testing.assert_allclose(epipolar_distance(a, b, fundamental), 0, atol=1e-3)
    lines = epipolar_lines(a, fundamental)
    assert abs(lines[0] @ homogeneous(b)[1]) > 1
    normals = lines[:, :2]
    np.testing.assert_allclose(epipolar_distance(a, b + 3 * normals, fundamental), 3, atol=1e-3)
