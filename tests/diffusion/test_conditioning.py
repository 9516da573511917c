"""The condition's channels stand in their documented order, and its null is the same everywhere."""

import math
from dataclasses import replace

import torch

from extrap_train.config import ModelConfig
from extrap_train.diffusion.conditioning import (
    Conditioning,
    Null,
    concatenated_latents,
    condition_channels,
    filled_warp,
    geometry_channels,
    positional_encoding,
)
from extrap_train.diffusion.encoders import PixelPatches
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.geometry.cameras import coordinate_grid
from extrap_train.geometry.warp import compute_warp
from extrap_train.views import PairBatch


def test_patches_decode_to_the_image_they_were_made_of() -> None:
    image = torch.rand(2, 3, 16, 16)
    patches = PixelPatches(4)
    assert patches.encode(image).shape == (2, 48, 4, 4)
    torch.testing.assert_close(patches.decode(patches.encode(image)), image)


def test_channels_stand_in_the_documented_order(batch: PairBatch) -> None:
    patches, octaves = PixelPatches(2), 3
    latents, warped = concatenated_latents(batch, patches, octaves)
    z, pe = patches.channels, 4 * octaves
    assert latents.shape[1] == condition_channels(z, octaves) == 2 * z + 2 * pe + 1
    reference, warp, own, encoded, mask = latents.split([z, z, pe, pe, 1], 1)
    torch.testing.assert_close(reference, patches.encode(batch.reference_images[:, 0]))
    assert batch.warp is not None
    torch.testing.assert_close(warp, patches.encode(filled_warp(batch.warp)))
    torch.testing.assert_close(warp, warped)
    grid = coordinate_grid(16, 16).expand(3, -1, -1, -1)
    torch.testing.assert_close(own, positional_encoding(grid, octaves))
    nearest = torch.nn.functional.avg_pool2d(batch.warp.nearest_mask[:, None], 2)
    assert torch.equal(encoded.abs().sum(1, keepdim=True) > 0, nearest > 0)
    torch.testing.assert_close(mask, torch.nn.functional.avg_pool2d(batch.warp.mask[:, None], 2))


def test_the_encoding_of_the_warp_points_at_the_reference_pixel(batch: PairBatch) -> None:
    """Query and reference of the same pose: the warped coordinates are the reference's own grid."""
    alone = torch.tensor([[True, False, False]] * 3)
    same = replace(batch, camera=batch.reference_cameras[:, 0], reference_valid=alone, warp=None)
    latents, _ = concatenated_latents(compute_warp(same), PixelPatches(2), 2)
    own, encoded = latents[:, 24:32], latents[:, 32:40]
    inside = (..., slice(2, -2), slice(2, -2))
    torch.testing.assert_close(encoded[inside], own[inside], atol=2e-2, rtol=0)


def test_the_filled_warp_keeps_known_pixels_and_leaves_no_black_holes(batch: PairBatch) -> None:
    assert batch.warp is not None
    filled = filled_warp(batch.warp)
    known = batch.warp.mask[:, None] > 0
    torch.testing.assert_close(
        torch.where(known, filled, 0), torch.where(known, batch.warp.image, 0)
    )
    low = torch.where(known, batch.warp.image, 1).amin((-2, -1), keepdim=True)
    assert (filled >= low - 1e-4).all()


def test_a_warp_without_any_pixel_is_filled_with_grey(batch: PairBatch) -> None:
    assert batch.warp is not None
    empty = replace(batch.warp, image=batch.warp.image * 0, mask=batch.warp.mask * 0)
    torch.testing.assert_close(filled_warp(empty), torch.full_like(empty.image, 0.5))


def test_zeroed_examples_are_null_and_the_others_untouched() -> None:
    one = Conditioning(
        torch.rand(2, 5, 4, 4), torch.rand(2, 7), torch.rand(2, 3, 4, 4), torch.ones(2)
    )
    some = one.zeroed(torch.tensor([True, False]))
    assert not some.latents[0].any()
    assert not some.embedding[0].any()
    assert torch.equal(some.latents[1], one.latents[1])
    assert torch.equal(some.base, one.base), "the base is added afterwards and is not a condition"
    doubled = one.doubled()
    assert torch.equal(doubled.latents[2:], one.zeroed(torch.tensor([True, True])).latents)


def test_a_null_takes_away_what_its_family_says_and_no_more() -> None:
    one = Conditioning(
        torch.rand(2, 7, 4, 4), torch.rand(2, 9), torch.rand(2, 3, 4, 4), torch.ones(2), Null(4, 6)
    )
    null = one.doubled()
    assert not null.latents[2:, :4].any()
    assert not null.embedding[2:, :6].any()
    assert torch.equal(null.latents[2:, 4:], one.latents[:, 4:]), "the warp is kept"
    assert torch.equal(null.embedding[2:, 6:], one.embedding[:, 6:]), "the pose is kept"
    assert torch.equal(null.token_weight, torch.ones(4))


def test_plain_zeros_silence_the_token_and_every_channel() -> None:
    one = Conditioning(
        torch.rand(2, 7, 4, 4), torch.rand(2, 9), torch.rand(2, 3, 4, 4), torch.ones(2), Null(4, 6)
    )
    null = one.doubled(plain_zeros=True)
    assert not null.latents[2:].any()
    assert null.token_weight.tolist() == [1, 1, 0, 0]


def test_geometry_is_told_in_units_of_the_scene_and_is_zero_in_holes(
    config: ModelConfig, batch: PairBatch
) -> None:
    assert batch.warp is not None
    told = geometry_channels(batch.warp, torch.full((3,), 2.0), 2)
    mask = torch.nn.functional.avg_pool2d(batch.warp.mask[:, None], 2)
    whole = mask == 1
    expected = torch.nn.functional.avg_pool2d(2.0 / batch.warp.depth.clamp_min(1e-6)[:, None], 2)
    torch.testing.assert_close(told[:, :1][whole], expected[whole])
    assert not told[:, :1][mask == 0].any()
    assert 0 <= told[:, 1].min() <= told[:, 1].max() <= 1
    larger = replace(batch.warp, depth=7 * batch.warp.depth)
    torch.testing.assert_close(geometry_channels(larger, torch.full((3,), 14.0), 2), told)
    model = ExtrapolationModel(replace(config, geometry=True))
    plain = ExtrapolationModel(config).condition(batch).latents
    latents = model.condition(batch).latents
    assert torch.equal(latents[:, :-2], plain), "the further channels come last"
    assert model.unet.config.in_channels == 12 + latents.shape[1]


def test_channels_go_by_octave_then_sine_and_cosine() -> None:
    coordinates = torch.tensor([0.25, -0.5]).reshape(1, 2, 1, 1)
    encoded = positional_encoding(coordinates, 2)[0, :, 0, 0]
    angles = [math.pi * 0.25, -math.pi * 0.5]
    expected = [f(n * a) for n in (1, 2) for f in (math.sin, math.cos) for a in angles]
    assert torch.allclose(encoded, torch.tensor(expected), atol=1e-6)
