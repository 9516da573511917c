"""A warp whose points are moved: everything goes along, in both implementations."""

import torch
from scenes import SPHERE_ON_PLANE, orbit_camera

from extrap_train.geometry.warp import warp_references
from extrap_train.views import Camera, Warp, stack_cameras

SIZE = 64


def warp(flows: torch.Tensor | None, gradients: bool = False) -> Warp:
    cameras = [orbit_camera(azimuth, size=SIZE) for azimuth in (0, 25)]
    query = stack_cameras([orbit_camera(12, size=SIZE)])
    images = torch.stack([SPHERE_ON_PLANE.image(camera) for camera in cameras])[None]
    depths = torch.stack([SPHERE_ON_PLANE.depth(camera) for camera in cameras])[None]
    valid = torch.ones(1, 2, dtype=torch.bool)
    both: Camera = stack_cameras([stack_cameras(cameras)])
    return warp_references(images.requires_grad_(gradients), depths, both, valid, query, flows)


def test_a_flow_of_zero_changes_nothing() -> None:
    plain, moved = warp(None), warp(torch.zeros(1, 2, 2, 6, 6))
    # Adding a flow is another computation, which may be fused, and so rounded, otherwise.
    torch.testing.assert_close(plain.image, moved.image, atol=1e-5, rtol=0)
    torch.testing.assert_close(plain.coordinates, moved.coordinates, atol=1e-5, rtol=0)


def test_whole_pixels_move_colours_coordinates_depth_and_mask_together() -> None:
    flows = torch.zeros(1, 2, 2, 6, 6)
    flows[:, :, 0], flows[:, :, 1] = 3 * 2 / SIZE, -2 * 2 / SIZE
    plain, moved = warp(None), warp(flows)
    for name in ("image", "coordinates", "depth", "mask", "nearest_mask"):
        before, after = getattr(plain, name), getattr(moved, name)
        # Away from the border: points beyond it were not drawn, so nothing moves in from there.
        expected, found = before[..., 6:-6, 6:-6], after[..., 4:-8, 9:-3]
        differs = (expected - found).abs() > 1e-4
        assert differs.float().mean() < 0.01, name


def test_each_reference_moves_by_its_own_flow() -> None:
    flows = torch.zeros(1, 2, 2, 6, 6)
    flows[0, 1] = 0.2
    plain, moved = warp(None), warp(flows)
    both = (plain.nearest_mask * moved.nearest_mask)[0] > 0
    step = (plain.coordinates - moved.coordinates)[0, :, both].abs()
    assert step.median() < 1e-5, "the nearest reference stays"
    assert (plain.image - moved.image).abs().mean() > 0.01, "the other one does not"


def test_torch_and_numba_move_alike() -> None:
    flows = 0.1 * torch.randn(1, 2, 2, 6, 6, generator=torch.Generator().manual_seed(0))
    fast, slow = warp(flows), warp(flows, gradients=True)
    assert slow.image.requires_grad
    difference = (fast.image - slow.image.detach()).abs().amax(1)
    assert (difference > 1e-3).float().mean() < 0.01


def test_each_moved_pixels_coordinate_still_samples_its_colour() -> None:
    flows = 0.05 * torch.randn(1, 2, 2, 6, 6, generator=torch.Generator().manual_seed(1))
    flows[:, 1] = 5.0  # the second reference out of the picture: every colour is the first's
    moved = warp(flows)
    image = SPHERE_ON_PLANE.image(orbit_camera(0, size=SIZE))[None]
    at = moved.coordinates.permute(0, 2, 3, 1)
    sampled = torch.nn.functional.grid_sample(image, at, align_corners=False)
    seen = moved.nearest_mask[0] > 0
    error = (sampled - moved.image)[0, :, seen].abs().mean(0)
    assert seen.float().mean() > 0.3
    assert error.median() < 1 / 255
    assert error.quantile(0.95) < 6 / 255
