"""Image metrics with declared ranges: every image is float in [0, 1], `b 3 h w`; results are one
number an image.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from skimage.metrics import structural_similarity
from torch import Tensor

from extrap_train.errors import InputError
from extrap_train.weight_files import WeightFile

_SQUEEZENET = "squeezenet1_1-b8a52dc0.pth"


def quantised(image: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 3 h w"]:
    """What an 8-bit file would keep: predictions and truth are compared as they would be saved."""
    return (image.clamp(0, 1) * 255).round() / 255


def psnr(
    prediction: Float[Tensor, "b 3 h w"],
    truth: Float[Tensor, "b 3 h w"],
    mask: Float[Tensor, "b h w"] | None = None,
) -> Float[Tensor, " b"]:
    """Peak signal-to-noise ratio in dB, over the pixels where `mask` is 1; NaN if none."""
    error = (prediction - truth).square().mean(1)
    weight = torch.ones_like(error) if mask is None else mask
    mean = (error * weight).sum((-2, -1)) / weight.sum((-2, -1))
    return -10 * torch.log10(mean.clamp_min(1e-10))


def ssim(
    prediction: Float[Tensor, "b 3 h w"], truth: Float[Tensor, "b 3 h w"]
) -> Float[Tensor, " b"]:
    """Structural similarity as published: 11×11 Gaussian window, population covariance."""
    pairs = zip(_arrays(prediction), _arrays(truth), strict=True)
    values = [
        structural_similarity(
            a,
            b,
            channel_axis=0,
            data_range=1.0,
            gaussian_weights=True,
            sigma=1.5,
            use_sample_covariance=False,
        )
        for a, b in pairs
    ]
    return torch.tensor(values, dtype=torch.float32)


def _arrays(images: Tensor) -> np.ndarray:
    return images.detach().cpu().double().numpy()


def squeeze_lpips(
    weights: str | None,
) -> Callable[[Float[Tensor, "b 3 h w"], Float[Tensor, "b 3 h w"]], Float[Tensor, " b"]]:
    """LPIPS with the squeeze backbone, for images in [0, 1].

    `weights` is a full state dict; without it the backbone must lie in torch's hub cache. Raises
    InputError where neither is there: another network's number is never put in its place.
    """
    import lpips  # takes a second: only where the metric is wanted

    cached = Path(torch.hub.get_dir()) / "checkpoints" / _SQUEEZENET
    if weights is None and not cached.is_file():
        raise InputError(
            "LPIPS (squeeze) has no weights: give validation.lpips_weights=FILE or put "
            f"{_SQUEEZENET} into torch's hub cache"
        )
    network = lpips.LPIPS(net="squeeze", pnet_rand=weights is not None, verbose=False).eval()
    if weights is not None:
        file = WeightFile(
            Path(weights),
            "validation.lpips_weights",
            "the full state dict of lpips.LPIPS(net='squeeze')",
        )
        file.fill(network, file.tensors(file.read()))
    network.requires_grad_(False)

    @torch.no_grad()
    def distance(
        prediction: Float[Tensor, "b 3 h w"], truth: Float[Tensor, "b 3 h w"]
    ) -> Float[Tensor, " b"]:
        values = network(prediction.cpu(), truth.cpu(), normalize=True)
        return values.flatten()

    return distance


def lpips_or_reason(
    weights: str | None,
) -> tuple[
    Callable[[Float[Tensor, "b 3 h w"], Float[Tensor, "b 3 h w"]], Float[Tensor, " b"]] | None,
    dict[str, str],
]:
    """LPIPS (squeeze), or None and why; weights that are given and cannot be used are an error."""
    try:
        return squeeze_lpips(weights), {}
    except InputError as error:
        if weights is not None:
            raise
        return None, {"lpips": str(error)}
