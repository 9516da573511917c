"""The photometric loss equals scikit-image's SSIM inside, and a plain convolution everywhere."""

import numpy as np
import torch
from skimage.metrics import structural_similarity
from torch.nn import functional

from extrap_train.gaussians.losses import blur, photometric_loss, prepare_truth, ssim_map


def _pair(height: int = 40, width: int = 32) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    truth = torch.rand(3, height, width, generator=generator)
    return (truth + 0.2 * torch.randn(truth.shape, generator=generator)).clamp(0, 1), truth


def test_ssim_is_scikit_images_away_from_the_border():
    image, truth = _pair()
    _, expected = structural_similarity(
        image.numpy(), truth.numpy(), channel_axis=0, data_range=1.0, gaussian_weights=True,
        sigma=1.5, use_sample_covariance=False, full=True,
    )  # fmt: skip
    found = ssim_map(image, prepare_truth(truth))
    inside = (slice(None), slice(5, -5), slice(5, -5))
    np.testing.assert_allclose(found[inside].numpy(), expected[inside], atol=2e-5)


def test_the_window_is_a_zero_padded_convolution():
    image, _ = _pair()
    taps = torch.exp(-(torch.arange(-5, 6).float() ** 2) / (2 * 1.5**2))
    window = torch.outer(taps, taps) / taps.sum() ** 2
    expected = functional.conv2d(image[:, None], window[None, None], padding=5)[:, 0]
    torch.testing.assert_close(blur(image), expected, atol=1e-6, rtol=0)


def test_equal_images_lose_nothing_and_weights_are_those_given():
    image, truth = _pair()
    prepared = prepare_truth(truth)
    assert float(photometric_loss(truth, prepared, 0.2, 0.8)) < 1e-6
    l1 = (image - truth).abs().mean()
    torch.testing.assert_close(photometric_loss(image, prepared, 0.0, 1.0), l1)
    both = photometric_loss(image, prepared, 0.2, 1.0)
    torch.testing.assert_close(both, l1 + 0.2 * (1 - ssim_map(image, prepared).mean()))


def test_gradients_are_right():
    image, truth = (each[:, :12, :12].double() for each in _pair())
    prepared = prepare_truth(truth)
    assert torch.autograd.gradcheck(
        lambda x: photometric_loss(x, prepared, 0.2, 0.8), image.requires_grad_(), eps=1e-6
    )
