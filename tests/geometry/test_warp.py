"""The warp against ray-traced truth, and its invariances."""

from dataclasses import replace

import numba
import numpy as np
import pytest
import scenes
import torch
from PIL import Image

from extrap_train.geometry.warp import warp_references
from extrap_train.views import Camera, Warp, stack_cameras

SAME_SURFACE = 0.03  # relative depth


def references(scene, angles, size=256):
    cameras = stack_cameras([scenes.orbit_camera(angle, size=size) for angle in angles])
    images = torch.stack([scene.image(cameras[i]) for i in range(len(angles))])
    depths = torch.stack([scene.depth(cameras[i]) for i in range(len(angles))])
    return images[None], depths[None], stack_cameras([cameras])


def warp(images, depths, cameras, query, valid=None) -> Warp:
    valid = torch.ones(images.shape[:2], dtype=torch.bool) if valid is None else valid
    return warp_references(images, depths, cameras, valid, stack_cameras([query]))


def same(a: Warp, b: Warp, tolerance=1e-4):
    for name, value in vars(a).items():
        assert torch.allclose(value, getattr(b, name), atol=tolerance), name


def seen_from(scene, angle_deg) -> tuple[float, float, float]:
    """Measures of one reference's warp: the share of what both cameras see that is covered, the
    share of valid pixels that show another surface, and their mean colour error."""
    images, depths, cameras = references(scene, [0])
    query = scenes.orbit_camera(angle_deg, size=256)
    result = warp(images, depths, cameras, query)
    valid = result.mask[0] > 0
    visible = scene.visible_from(cameras[0, 0], query)
    truth = scene.depth(query)
    elsewhere = (result.depth[0] - truth).abs() > SAME_SURFACE * truth
    error = (result.image[0] - scene.image(query)).abs().mean(0)[valid].mean()
    covered = (valid & visible).sum() / visible.sum()
    return float(covered), float((valid & elsewhere).sum() / valid.sum()), float(error)


@pytest.mark.parametrize(
    ("scene", "angle_deg"),
    [
        (scenes.PLANE, 30),
        (scenes.PLANE, 60),
        (scenes.SPHERE, 30),
        (scenes.SPHERE, 45),
        (scenes.SPHERE_ON_PLANE, 45),
        (scenes.CARD_AND_PLANE, 45),
        (scenes.BOX_AND_PLANE, 30),
        (scenes.BOX_AND_PLANE, 45),
    ],
)
def test_warp_shows_what_is_visible_and_nothing_else(scene, angle_deg):
    covered, wrong, colour_error = seen_from(scene, angle_deg)
    assert covered >= 0.97
    assert wrong <= 0.005
    assert colour_error <= 2 / 255


@pytest.mark.parametrize(
    ("scene", "least_covered", "most_wrong"),
    [
        (scenes.SPHERE, 0.955, 0.007),
        (scenes.SPHERE_ON_PLANE, 0.97, 0.005),
        (scenes.CARD_AND_PLANE, 0.87, 0.003),
        (scenes.BOX_AND_PLANE, 0.95, 0.025),
    ],
)
def test_from_far_aside_one_depth_for_card_and_box_costs_both_little(
    scene, least_covered, most_wrong
):
    # From the reference they look the same: what is kept of one's wall shines through the other.
    covered, wrong, colour_error = seen_from(scene, 60)
    assert covered >= least_covered
    assert wrong <= most_wrong
    assert colour_error <= 2 / 255


def test_stretched_surface_has_no_pinholes():
    images, depths, cameras = references(scenes.PLANE, [0], size=64)
    query = scenes.orbit_camera(10, distance=1.2, size=256)
    result = warp(images, depths, cameras, query)
    assert result.mask[0][scenes.PLANE.visible_from(cameras[0, 0], query)].mean() > 0.999


def test_same_view_is_reproduced():
    images, depths, cameras = references(scenes.SPHERE_ON_PLANE, [0], size=64)
    result = warp(images, depths, cameras, cameras[0, 0])
    valid = result.mask[0] > 0
    assert valid.float().mean() > 0.95
    assert (result.image[0] - images[0, 0]).abs().amax(0)[valid].max() < 1e-3


def test_coordinates_point_at_the_nearest_reference():
    images, depths, cameras = references(scenes.PLANE, [0, 40], size=64)
    query = scenes.orbit_camera(25, size=64)
    result = warp(images, depths, cameras, query)
    sampled = torch.nn.functional.grid_sample(
        images[:, 0], result.coordinates.permute(0, 2, 3, 1), align_corners=False
    )
    inside = (result.nearest_mask[0] > 0) & (result.coordinates[0].abs().amax(0) < 0.95)
    assert (sampled[0] - scenes.PLANE.image(query)).abs().amax(0)[inside].mean() < 0.02
    assert result.nearest_mask.mean() < result.mask.mean()
    assert not result.coordinates[0][:, result.nearest_mask[0] == 0].any()


@pytest.mark.parametrize("count", [1, 2, 3])
def test_more_references_cover_more_and_invalid_ones_nothing(count):
    images, depths, cameras = references(scenes.SPHERE, [0, 50, -50][:count], size=64)
    query = scenes.orbit_camera(20, size=64)
    every = warp(images, depths, cameras, query)
    first = warp(images[:, :1], depths[:, :1], cameras[:, :1], query)
    assert every.mask.sum() >= first.mask.sum()
    valid = torch.zeros(1, count, dtype=torch.bool)
    valid[0, 0] = True
    same(warp(images, depths, cameras, query, valid), first, 0)
    nothing = warp(images, depths, cameras, query, ~valid & False)
    assert not any(value.any() for value in vars(nothing).values())


@pytest.mark.parametrize("unit", [1e3, 1e-3])
def test_unit_of_the_scene_does_not_matter(unit):
    images, depths, cameras = references(scenes.BOX_AND_PLANE, [0, 30], size=64)
    query = scenes.orbit_camera(20, size=64)
    world_to_cam = cameras.world_to_cam.clone()
    world_to_cam[..., :3, 3] *= unit
    result = warp(
        images,
        depths * unit,
        replace(cameras, world_to_cam=world_to_cam),
        scenes.scaled(query, unit),
    )
    plain = warp(images, depths, cameras, query)
    agree = (replace(result, depth=result.depth / unit).image - plain.image).abs().amax(1) < 1e-3
    assert agree.float().mean() > 0.998  # a point at a pixel's rim may round to its other side


def noisy(depths):
    """As sensors measure: steps, holes, and pixels that say nothing."""
    generator = torch.Generator().manual_seed(0)
    depths = depths * (1 + 0.02 * torch.randn(depths.shape, generator=generator))
    depths[torch.rand(depths.shape, generator=generator) < 0.05] = 0
    depths[torch.rand(depths.shape, generator=generator) < 0.02] = torch.nan
    return depths


@pytest.mark.parametrize(
    "query",
    [
        scenes.orbit_camera(25, size=80),
        scenes.orbit_camera(25, distance=1.3, elevation_deg=50, size=48),
        scenes.orbit_camera(140, distance=0.4, elevation_deg=-5, size=48, focal=0.5),
    ],
    ids=["beside", "close to the surface", "amid the scene"],
)
@pytest.mark.parametrize("change", [torch.clone, noisy], ids=["exact", "noisy"])
def test_torch_and_numba_agree(change, query):
    """Also where most of the surface lies outside the image, or behind it."""
    images, depths, cameras = references(scenes.SPHERE_ON_PLANE, [0, -30, 40], size=64)
    depths = change(depths)
    compiled = warp(images, depths, cameras, query)
    same(warp(images.clone().requires_grad_(), depths, cameras, query), compiled)


@pytest.mark.skipif(
    numba.config.NUMBA_NUM_THREADS < 2, reason="numba was started with one thread only"
)
def test_same_bits_on_one_and_two_threads():
    images, depths, cameras = references(scenes.BOX_AND_PLANE, [0, -30, 40], size=65)
    query = scenes.orbit_camera(25, size=81)
    before = numba.get_num_threads()
    results = []
    try:
        for threads in (1, 2, 2):
            numba.set_num_threads(threads)
            results.append(warp(images, depths, cameras, query))
    finally:
        numba.set_num_threads(before)
    for result in results[1:]:
        same(result, results[0], 0)


def test_gradients():
    images, depths, cameras = references(scenes.PLANE, [0, 30], size=8)
    cameras = replace(
        cameras, world_to_cam=cameras.world_to_cam.double(), intrinsics=cameras.intrinsics.double()
    )
    query = scenes.orbit_camera(17, elevation_deg=23, size=8)
    query = replace(
        query, world_to_cam=query.world_to_cam.double(), intrinsics=query.intrinsics.double()
    )

    def colours_and_depth(image, depth):
        result = warp(image, depth, cameras, query)
        return result.image, result.depth

    inputs = (images.double().requires_grad_(), depths.double().requires_grad_())
    assert torch.autograd.gradcheck(colours_and_depth, inputs, eps=1e-7, atol=1e-4, fast_mode=True)


def test_points_behind_the_query_and_broken_depths_do_no_harm():
    images, depths, cameras = references(scenes.SPHERE_ON_PLANE, [0], size=64)
    depths[..., :20, :] = 0
    depths[..., 20, :] = torch.nan
    depths[..., 21, :] = torch.inf
    inside = scenes.orbit_camera(30, distance=0.1, size=64)
    for query in (scenes.orbit_camera(180, distance=-4.0, size=64), inside):
        result = warp(images, depths, cameras, query)
        assert all(torch.isfinite(value).all() for value in vars(result).values())


def test_real_depth_agrees_from_frame_to_frame(shared):
    folder = shared / "data/rgbd_7scenes"
    intrinsics = torch.from_numpy(np.loadtxt(folder / "camera-intrinsics.txt")).float()
    first, second = sorted(folder.glob("*.depth.png"))[:2]

    def read(path):
        depth = torch.from_numpy(np.asarray(Image.open(path)).astype(np.float32)) / 1000
        depth = torch.where(depth < 60, depth, 0)
        pose = np.loadtxt(str(path).replace("depth.png", "pose.txt"))
        return depth, Camera(
            torch.from_numpy(np.linalg.inv(pose)).float(), intrinsics, *depth.shape
        )

    (depth, camera), (query_depth, query) = read(first), read(second)
    cameras = stack_cameras([stack_cameras([camera])])
    result = warp(torch.zeros(1, 1, 3, *depth.shape), depth[None, None], cameras, query)
    both = (result.mask[0] > 0) & (query_depth > 0)
    error = ((result.depth[0] - query_depth).abs() / query_depth)[both]
    assert result.mask.mean() > 0.5
    assert error.median() < 0.01
