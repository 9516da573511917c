"""Reducing a batch keeps what is known, where it lies, and which camera sees it."""

import math
from dataclasses import replace

import torch

from extrap_train.geometry.cameras import unproject
from extrap_train.geometry.resample import reduce_batch, reduce_warp
from extrap_train.geometry.warp import warp_references
from extrap_train.views import Camera, PairBatch, Warp


def camera(size: int, azimuth_rad: float = 0.0) -> Camera:
    cosine, sine = math.cos(azimuth_rad), math.sin(azimuth_rad)
    world_to_cam = torch.tensor(
        [[cosine, 0, -sine, 0], [0, 1, 0, 0], [sine, 0, cosine, 4], [0, 0, 0, 1]]
    )
    half = size / 2
    intrinsics = torch.tensor([[1.2 * size, 0, half], [0, 1.2 * size, half], [0, 0, 1.0]])
    return Camera(world_to_cam[None], intrinsics[None], size, size)


def warp_of(mask: list[list[float]]) -> Warp:
    known = torch.tensor([mask], dtype=torch.float32)
    count = torch.arange(known.numel(), dtype=torch.float32).view_as(known)
    return Warp(
        image=(count * known)[:, None].expand(-1, 3, -1, -1),
        coordinates=(count * known)[:, None].expand(-1, 2, -1, -1),
        depth=count * known,
        weight=known,
        mask=known,
        nearest_mask=known,
    )


def test_a_block_is_the_mean_of_its_known_pixels() -> None:
    reduced = reduce_warp(warp_of([[1, 0, 0, 0], [1, 1, 0, 0]]), 2)
    assert reduced.mask.tolist() == [[[1, 0]]]
    expected = (0 + 4 + 5) / 3
    torch.testing.assert_close(reduced.image[0, :, 0, 0], torch.full((3,), expected))
    torch.testing.assert_close(reduced.coordinates[0, :, 0, 0], torch.full((2,), expected))
    torch.testing.assert_close(reduced.depth[0, 0], torch.tensor([expected, 0.0]))
    torch.testing.assert_close(reduced.weight[0, 0], torch.tensor([0.75, 0.0]))


def test_the_nearest_reference_has_a_mask_of_its_own() -> None:
    nearest = torch.tensor([[[1.0, 0, 0, 0], [0, 0, 0, 0]]])
    warp = replace(warp_of([[1, 1, 1, 1], [1, 1, 1, 1]]), nearest_mask=nearest)
    reduced = reduce_warp(warp, 2)
    assert reduced.mask.tolist() == [[[1, 1]]]
    assert reduced.nearest_mask.tolist() == [[[1, 0]]]


def test_depth_is_that_of_a_pixel_beside_the_middle_of_its_block() -> None:
    """Half a fine pixel off: the block's first pixel would be a pixel and a half off."""
    batch = wall(8)
    depths = torch.arange(64.0).view(1, 1, 8, 8)
    reduced = reduce_batch(replace(batch, reference_depths=depths), 4)
    assert reduced.reference_depths.flatten().tolist() == [18, 22, 50, 54]


def test_holes_stay_zero_and_marked() -> None:
    reduced = reduce_warp(warp_of([[0, 0], [0, 0]]), 2)
    assert not reduced.mask.any()
    assert not reduced.image.any()


def wall(size: int) -> PairBatch:
    """A wall 4 units away in the first camera's picture, brighter to the right."""
    ramp = torch.linspace(0, 1, size).expand(1, 1, 3, size, size)
    reference = camera(size)
    return PairBatch(
        image=ramp[:, 0],
        camera=camera(size, 0.2),
        reference_images=ramp,
        reference_cameras=Camera(
            reference.world_to_cam[:, None], reference.intrinsics[:, None], size, size
        ),
        reference_depths=torch.full((1, 1, size, size), 4.0),
        reference_valid=torch.ones(1, 1, dtype=torch.bool),
    )


def test_a_block_is_the_objects_where_it_covers_half() -> None:
    mask = torch.zeros(1, 4, 4, dtype=torch.bool)
    mask[0, 0, :2] = mask[0, 2, 2] = True  # two pixels of the first block, one of the last
    reduced = reduce_batch(replace(wall(4), object_mask=mask), 2)
    assert reduced.object_mask is not None
    assert reduced.object_mask[0].tolist() == [[True, False], [False, False]]


def test_the_reduced_cameras_see_the_same_rays() -> None:
    """The reduced wall's points are those of the blocks' middles."""
    whole, half = wall(16), reduce_batch(wall(16), 2)
    points = unproject(whole.reference_depths[0, 0], whole.reference_cameras[0, 0])
    middles = points.unfold(0, 2, 2).unfold(1, 2, 2).mean((-1, -2))
    found = unproject(half.reference_depths[0, 0], half.reference_cameras[0, 0])
    torch.testing.assert_close(found, middles, atol=1e-5, rtol=0)


def test_a_reduced_warp_agrees_with_a_warp_of_reduced_views() -> None:
    """On a smooth wall both ways show the same; only the fine one keeps grazing surfaces whole."""
    fine, coarse = wall(64), reduce_batch(wall(64), 2)
    warps = [
        warp_references(
            b.reference_images, b.reference_depths, b.reference_cameras, b.reference_valid, b.camera
        )
        for b in (fine, coarse)
    ]
    reduced = reduce_warp(warps[0], 2)
    both = (reduced.mask * warps[1].mask)[:, None]
    assert both.mean() > 0.7
    assert ((reduced.image - warps[1].image).abs() * both).max() < 0.05


def test_a_factor_of_one_changes_nothing() -> None:
    batch = wall(8)
    assert reduce_batch(batch, 1) is batch
