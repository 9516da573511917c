"""Positional encoding."""

import math

import torch

from extrap_train.geometry.encoding import coordinate_grid, positional_encoding


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
