"""The splat of plain points: its formula, its repeatability, its two implementations."""

import numba
import pytest
import scenes
import torch

from extrap_train.geometry.warp import splat_points
from extrap_train.geometry.warp.splat import DEPTH_SHARPNESS
from extrap_train.views import Camera


def pinhole(size=8):
    return Camera(torch.eye(4), torch.tensor([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]]), size, size)


def cloud(count=4000, channels=7):
    generator = torch.Generator().manual_seed(1)
    points = torch.rand(count, 3, generator=generator) * 2 - 1
    return points, torch.rand(count, channels, generator=generator)


def test_two_points_blend_by_kernel_and_depth():
    z = torch.tensor([2.0, 2.01])
    points = torch.stack([torch.tensor([3.5, 3.75]) * z, 3.5 * z, z], -1)
    drawn = splat_points(points, torch.tensor([[1.0], [0.0]]), pinhole())
    weight = 0.75 * torch.exp(torch.tensor(-DEPTH_SHARPNESS * 0.005))
    assert torch.allclose(drawn[-1, 3, 3], 1 + weight, atol=1e-4)
    assert torch.allclose(drawn[0, 3, 3], 1 / (1 + weight), atol=1e-4)
    assert drawn[-1, 3, 5] == 0


def test_nearer_point_hides_the_farther():
    points = torch.tensor([[7.0, 7.0, 2.0], [14.0, 14.0, 4.0]])
    drawn = splat_points(points, torch.tensor([[1.0], [9.0]]), pinhole())
    assert drawn[0, 3, 3] == 1.0


@pytest.mark.parametrize("channels", [1, 7, 12])
def test_torch_and_numba_agree(channels):
    points, values = cloud(channels=channels)
    camera = scenes.orbit_camera(20, size=48)
    compiled = splat_points(points, values, camera)
    vectorised = splat_points(points, values.clone().requires_grad_(), camera)
    assert torch.allclose(compiled[:-1], vectorised[:-1], atol=1e-4)
    assert torch.allclose(compiled[-1], vectorised[-1], atol=1e-4)


@pytest.mark.skipif(
    numba.config.NUMBA_NUM_THREADS < 2, reason="numba was started with one thread only"
)
@pytest.mark.parametrize("size", [48, 7])
def test_same_bits_on_one_and_two_threads(size):
    points, values = cloud()
    camera = scenes.orbit_camera(20, size=size)
    before = numba.get_num_threads()
    results = []
    try:
        for threads in (1, 2, 2):
            numba.set_num_threads(threads)
            results.append(splat_points(points, values, camera))
    finally:
        numba.set_num_threads(before)
    for result in results[1:]:
        assert torch.equal(result[:-1], results[0][:-1])
        assert torch.equal(result[-1], results[0][-1])


def test_points_behind_the_camera_are_not_drawn():
    drawn = splat_points(
        torch.tensor([[0.0, 0.0, -1.0], [0.0, 0.0, 0.0]]), torch.ones(2, 3), pinhole()
    )
    assert not drawn[-1].any()
