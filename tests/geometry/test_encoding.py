"""Positional encoding."""

import math

import scenes
import torch

from extrap_train.geometry.encoding import coordinate_grid, positional_encoding, warp_encoding
from extrap_train.geometry.warp import warp_references
from extrap_train.views import stack_cameras


def test_channels_go_by_octave_then_sine_and_cosine():
    coordinates = torch.tensor([0.25, -0.5]).reshape(1, 2, 1, 1)
    encoded = positional_encoding(coordinates, 2)[0, :, 0, 0]
    angles = [math.pi * 0.25, -math.pi * 0.5]
    expected = [f(n * a) for n in (1, 2) for f in (math.sin, math.cos) for a in angles]
    assert torch.allclose(encoded, torch.tensor(expected), atol=1e-6)


def test_grid_has_normalised_pixel_centres():
    grid = coordinate_grid(2, 4)
    assert torch.allclose(grid[0, 0], torch.tensor([-0.75, -0.25, 0.25, 0.75]))
    assert torch.allclose(grid[1, :, 0], torch.tensor([-0.5, 0.5]))


def test_holes_are_encoded_as_zero():
    camera = scenes.orbit_camera(0, size=32)
    image, depth = scenes.SPHERE.image(camera), scenes.SPHERE.depth(camera)
    warp = warp_references(
        image[None, None],
        depth[None, None],
        stack_cameras([stack_cameras([camera])]),
        torch.ones(1, 1, dtype=torch.bool),
        stack_cameras([scenes.orbit_camera(40, size=32)]),
    )
    encoded = warp_encoding(warp, 3)
    hole = warp.nearest_mask[0] == 0
    assert encoded.shape == (1, 12, 32, 32)
    assert hole.any()
    assert not encoded[0][:, hole].any()
    assert encoded[0][:, ~hole].abs().amax(0).min() > 0
