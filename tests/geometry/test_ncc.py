import numpy as np
import torch

from extrap_train.geometry.ncc import WINDOW, windowed_correlation


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
