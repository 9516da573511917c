import pytest
import torch
from traced_scenes import SCENES, orbit_camera, render

from extrap_train.depth import photo_cost
from extrap_train.depth.photo_cost import PhotoCost, projection_between
from extrap_train.geometry.cameras import project, unproject_to_world


def test_projection_is_unprojecting_and_projecting():
    source, target = orbit_camera(0, 20), orbit_camera(25, 30)
    depth = 1.5 + torch.rand(20, 20, generator=torch.Generator().manual_seed(0))
    pixels, scale = projection_between(source, target).points(1 / depth)
    expected, target_depth = project(unproject_to_world(depth, source).flatten(0, 1), target)
    torch.testing.assert_close(pixels.flatten(0, 1), expected, atol=1e-3, rtol=0)
    torch.testing.assert_close((scale * depth).flatten(), target_depth)


def views_of_plane():
    return [
        render(SCENES["slanted plane"], orbit_camera(azimuth_deg, 96), gain)
        for azimuth_deg, gain in ((0, 1.0), (-8, 0.7), (8, 1.2))
    ]


def test_cost_is_low_at_the_true_depth_whatever_the_exposure():
    view, *neighbours = views_of_plane()
    factors = torch.tensor([0.9, 0.97, 1.0, 1.03, 1.1])
    cost = PhotoCost(view, neighbours)(factors[:, None, None] / view.depth)
    assert (cost.argmin(0) == 2).float().mean() > 0.97
    assert cost[2].median() < 0.02


def test_what_no_neighbour_sees_costs_neither_much_nor_little():
    view, *neighbours = views_of_plane()
    hidden = torch.full((1, 96, 96), 1e4)
    torch.testing.assert_close(
        PhotoCost(view, neighbours)(hidden), torch.full((1, 96, 96), 0.5), atol=0, rtol=0
    )


SIZES = ((60, 96), (80, 70), (96, 50))


@pytest.mark.parametrize("count", [1, 2, 4])
def test_the_kernel_and_torch_agree(count):
    view, *neighbours = views_of_plane()
    view, first, second = (
        v.resized(*size) for v, size in zip([view, *neighbours], SIZES, strict=True)
    )
    cost = PhotoCost(view, [first, second, second, first][:count])
    inverse_depth = torch.linspace(-0.1, 3.0, 9)[:, None, None].expand(9, *SIZES[0])
    difference = (cost(inverse_depth) - cost.cost_torch(inverse_depth)).abs()
    # Variances are differences of rounded moments: where there is little texture they are noise.
    assert difference.mean() < 1e-4
    assert (difference > 1e-2).float().mean() < 1e-3


def test_chunks_do_not_change_the_cost(monkeypatch):
    view, *neighbours = views_of_plane()
    inverse_depth = torch.linspace(0.3, 0.6, 7)[:, None, None].expand(7, 96, 96)
    at_once = PhotoCost(view, neighbours)(inverse_depth)
    monkeypatch.setattr(photo_cost, "CHUNK_COSTS", 1)
    chunked = PhotoCost(view, neighbours)(inverse_depth)
    # Vectorised kernels may round the ends of tensors otherwise than their middles.
    torch.testing.assert_close(chunked, at_once, atol=1e-5, rtol=0)
