import numpy as np
import torch

from extrap_train.geometry.ncc import (
    CONSISTENT_CORRELATION,
    MIN_TEXTURE,
    WINDOW,
    ncc_consistent,
    windowed_correlation,
)


def test_correlation_is_numpys_in_every_window():
    generator = torch.Generator().manual_seed(0)
    first = torch.rand(2, 20, 24, generator=generator)
    second = 0.6 * first + 0.4 * torch.rand(2, 20, 24, generator=generator)
    known = (torch.rand(20, 24, generator=generator) > 0.3).float()
    found = windowed_correlation(first, second, known)
    reach = WINDOW // 2
    for row, column in ((3, 3), (10, 12), (16, 20), (8, 17)):
        window = (
            slice(row - reach, row + reach + 1),
            slice(column - reach, column + reach + 1),
        )
        inside = known[window].bool()
        channels = [
            np.corrcoef(a[window][inside], b[window][inside])[0, 1]
            for a, b in zip(first, second, strict=True)
        ]
        np.testing.assert_allclose(found[row, column], max(np.mean(channels), 0), atol=1e-3)


def test_a_contrast_and_a_brightness_change_nothing_and_a_negative_is_unlike():
    picture = torch.rand(3, 16, 16, generator=torch.Generator().manual_seed(0))
    known = torch.ones(16, 16)
    assert (windowed_correlation(picture, 0.3 * picture + 0.2, known) > 0.99).all()
    assert (windowed_correlation(picture, 1 - picture, known) == 0).all()


def test_consistent_windows_are_those_that_numpy_correlates():
    generator = torch.Generator().manual_seed(0)
    first = 0.2 * torch.rand(3, 24, 24, generator=generator)
    first[:, :, 16:] = 0.5
    noise = 0.2 * torch.rand(3, 24, 24, generator=generator)
    second = torch.where(torch.arange(24) < 8, first, 0.4 * first + 0.6 * noise)
    known = torch.rand(24, 24, generator=generator) > 0.3
    consistent, comparable = ncc_consistent(first, second, known)
    reach = WINDOW // 2
    a, b = (np.pad(image.double().mean(0).numpy(), reach) for image in (first, second))
    inside = np.pad(known.numpy(), reach)
    for row, column in np.ndindex(24, 24):
        window = slice(row, row + WINDOW), slice(column, column + WINDOW)
        chosen = inside[window]
        x, y = a[window][chosen], b[window][chosen]
        enough = known[row, column] and chosen.sum() > WINDOW**2 / 2
        textured = enough and max(x.var(), y.var()) > MIN_TEXTURE
        assert bool(comparable[row, column]) == textured
        correlation = np.corrcoef(x, y)[0, 1] if textured and min(x.var(), y.var()) > 0 else 0
        if abs(correlation - CONSISTENT_CORRELATION) > 1e-3:
            assert bool(consistent[row, column]) == (correlation > CONSISTENT_CORRELATION)


def test_a_match_outside_of_the_mask_is_never_comparable():
    picture = torch.rand(3, 16, 16, generator=torch.Generator().manual_seed(0))
    consistent, comparable = ncc_consistent(picture, picture, torch.zeros(16, 16).bool())
    assert not (consistent | comparable).any()
