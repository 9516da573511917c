import torch
from scenes import orbit_camera

from extrap_train.geometry.cameras import project
from extrap_train.geometry.epipolar import triangulate

FIRST, SECOND = orbit_camera(0), orbit_camera(30)


def points(count: int = 50) -> torch.Tensor:
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(0)) - 0.5


def test_points_get_their_depth_and_the_angle_between_their_rays():
    world = points()
    (pixels, depth), (others, _) = project(world, FIRST), project(world, SECOND)
    found = triangulate(pixels, others, FIRST, SECOND)
    torch.testing.assert_close(found.depth, depth, atol=1e-4, rtol=1e-4)
    assert found.error.max() < 1e-2
    one, two = world - FIRST.center, world - SECOND.center
    angle_rad = torch.acos((one * two).sum(-1) / one.norm(dim=-1) / two.norm(dim=-1))
    torch.testing.assert_close(found.parallax_rad, angle_rad, atol=1e-3, rtol=1e-3)


def test_a_match_off_the_epipolar_line_says_how_far():
    world = points()
    (pixels, depth), (others, _) = project(world, FIRST), project(world, SECOND)
    moved = others + torch.tensor([0.0, 4.0])  # the cameras stand side by side
    found = triangulate(pixels, moved, FIRST, SECOND)
    assert ((found.error > 3) & (found.error <= 4.01)).all()
    assert (found.depth / depth - 1).abs().median() < 0.05


def test_rays_that_part_have_no_depth():
    world = points()
    (pixels, _), (others, _) = project(world, FIRST), project(world, SECOND)
    far = others + torch.tensor([400.0, 0.0])  # beyond parallel
    near = others - torch.tensor([400.0, 0.0])
    parted = [triangulate(pixels, x, FIRST, SECOND).depth <= 0 for x in (far, near)]
    assert parted[0].all() != parted[1].all()


def test_one_place_gives_no_number_that_is_not_finite():
    pixels = torch.rand(5, 2) * 128
    found = triangulate(pixels, pixels, FIRST, FIRST)
    assert found.depth.isfinite().all()
    assert (found.parallax_rad < 1e-3).all()
