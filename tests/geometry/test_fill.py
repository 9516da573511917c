"""Holes are filled smoothly and known pixels stay as they are."""

import torch

from extrap_train.geometry.resample import fill_holes


def test_known_pixels_stay_and_a_constant_image_is_restored() -> None:
    generator = torch.Generator().manual_seed(0)
    mask = (torch.rand(2, 37, 50, generator=generator) > 0.6).float()
    image = torch.rand(2, 3, 37, 50, generator=generator) * mask[:, None]
    filled = fill_holes(image, mask)
    assert torch.equal(filled * mask[:, None], image)
    torch.testing.assert_close(
        fill_holes(0.3 * mask[:, None], mask), torch.full((2, 1, 37, 50), 0.3)
    )


def test_a_narrow_hole_continues_its_rim_and_a_wide_one_takes_the_mean() -> None:
    image = torch.zeros(1, 1, 64, 64)
    image[..., :32] = 1  # left half white, right half black
    mask = torch.ones(1, 64, 64)
    mask[:, 20, 10] = mask[:, 20, 50] = 0
    narrow = fill_holes(image * mask[:, None], mask)
    assert narrow[0, 0, 20, 10] == 1
    assert narrow[0, 0, 20, 50] == 0
    mask[:, :, 40:] = 0
    wide = fill_holes(image * mask[:, None], mask)
    mean = (image * mask[:, None]).sum() / mask.sum()
    torch.testing.assert_close(wide[0, 0, 10:50, 50:60], mean.expand(40, 10))


def test_nothing_known_is_zero() -> None:
    assert not fill_holes(torch.ones(1, 3, 16, 16), torch.zeros(1, 16, 16)).any()
