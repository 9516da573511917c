"""Pillow is the oracle: its `LANCZOS` in floating point."""

import numpy as np
import pytest
import torch
from PIL import Image

from extrap_train.geometry.resample import lanczos_resize


@pytest.mark.parametrize("size", [(64, 64), (48, 100)])
@pytest.mark.parametrize("target", [(32, 32), (7, 19), (80, 120)])
def test_it_resamples_as_pillow_does(size: tuple[int, int], target: tuple[int, int]) -> None:
    image = torch.rand(size, generator=torch.Generator().manual_seed(0))
    pillow = Image.fromarray(image.numpy(), mode="F").resize(target[::-1], Image.Resampling.LANCZOS)
    resized = lanczos_resize(image, *target)
    torch.testing.assert_close(resized, torch.from_numpy(np.array(pillow)), atol=1e-5, rtol=0)


def test_a_constant_stays_one() -> None:
    torch.testing.assert_close(
        lanczos_resize(torch.full((1, 3, 9, 9), 0.3), 4, 5), torch.full((1, 3, 4, 5), 0.3)
    )
