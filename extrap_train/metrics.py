"""Image metrics with declared ranges: every image is float in [0, 1], `b 3 h w`; results are one
number an image.
"""

import math
import re
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from unittest.mock import patch

import numpy as np
import torch
from jaxtyping import Float
from skimage.metrics import structural_similarity
from torch import Tensor, nn

from extrap_train.errors import InputError
from extrap_train.weight_files import WeightFile

Distance = Callable[[Tensor, Tensor], Tensor]
"""Predictions and truths, `b 3 h w` in [0, 1], to a number each."""

BACKBONES = {
    "alex": "alexnet-owt-7be5be79.pth",
    "vgg": "vgg16-397923af.pth",
    "squeeze": "squeezenet1_1-b8a52dc0.pth",
}
"""torchvision's files, by LPIPS's names; each ends with the first digits of its SHA-256."""
_DOWNLOADS = "https://download.pytorch.org/models"
_CONVOLUTION = re.compile(r"^(?:net\.slice|stage)\d+\.(?P<layer>\d+)\.(?P<kind>.*(?:weight|bias))$")
"""LPIPS and DISTS name a backbone's layers by its own numbers."""


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
    prediction: Float[Tensor, "b 3 h w"],
    truth: Float[Tensor, "b 3 h w"],
    mask: Float[Tensor, "b h w"] | None = None,
) -> Float[Tensor, " b"]:
    """Structural similarity as published: 11×11 Gaussian window, population covariance.

    With a mask, the mean of the similarity map over the pixels where it is 1; NaN if none. Without,
    scikit-image's mean, which leaves out a border of half a window.
    """
    values = []
    for index, (a, b) in enumerate(zip(_arrays(prediction), _arrays(truth), strict=True)):
        mean, similarity = structural_similarity(
            a,
            b,
            channel_axis=0,
            data_range=1.0,
            gaussian_weights=True,
            sigma=1.5,
            use_sample_covariance=False,
            full=True,
        )
        if mask is None:
            values.append(mean)
        else:
            inside = similarity.mean(0)[mask[index].cpu().numpy() > 0]
            values.append(inside.mean() if inside.size else math.nan)
    return torch.tensor(values, dtype=torch.float32)


def require_unit_range(images: Float[Tensor, "b 3 h w"]) -> None:
    """Raise ValueError unless every colour is a number in [0, 1]: not [-1, 1], not 0 … 255."""
    low, high = float(images.min()), float(images.max())
    if not (low >= 0 and high <= 1):  # NaN is neither
        raise ValueError(f"colours from {low:g} to {high:g}; metrics take images in [0, 1]")


def _arrays(images: Tensor) -> np.ndarray:
    return images.detach().cpu().double().numpy()


def squeeze_lpips(weights: str | None) -> Distance:
    """LPIPS with the squeeze backbone; see `lpips_distance`."""
    return lpips_distance("squeeze", weights, "validation.lpips_weights")


def lpips_distance(net: str, weights: str | None, option: str) -> Distance:
    """LPIPS with the backbone `alex`, `vgg` or `squeeze`, for images in [0, 1].

    `weights` is a full state dict; without it the backbone must lie in torch's hub cache. Raises
    InputError if neither can be used: no other network's number ever takes its place. `option` is
    what the user sets `weights` with.
    """
    import lpips  # takes a second: only where the metric is wanted

    if weights is None and not (hub_cache() / BACKBONES[net]).is_file():
        raise InputError(
            f"LPIPS ({net}) has no weights: give {option}=FILE or put {BACKBONES[net]} into "
            "torch's hub cache"
        )
    backbone = _cached_backbone(net) if weights is None else None
    with warnings.catch_warnings():  # it calls torchvision in a manner that is going out of use
        warnings.simplefilter("ignore", UserWarning)
        network = lpips.LPIPS(net=net, pnet_rand=True, verbose=False).eval()
    if backbone is not None:
        _fill_backbone(network, *backbone)
    elif weights is not None:
        file = WeightFile(Path(weights), option, f"the full state dict of lpips.LPIPS(net='{net}')")
        file.fill(network, file.tensors(file.read()))
    network.requires_grad_(False)

    return _distance_by(partial(network, normalize=True))


def lpips_or_reason(weights: str | None) -> tuple[Distance | None, dict[str, str]]:
    """LPIPS (squeeze), or None and why; weights that are given and cannot be used are an error."""
    try:
        return squeeze_lpips(weights), {}
    except InputError as error:
        if weights is not None:
            raise
        return None, {"lpips": str(error)}


def dists_distance() -> Distance:
    """DISTS (Ding et al., 2020) by torchmetrics, for images in [0, 1].

    Raises InputError if torchvision's VGG-16 is not in torch's hub cache, or damaged.
    """
    if not (hub_cache() / BACKBONES["vgg"]).is_file():
        raise InputError(f"DISTS has no weights: put {BACKBONES['vgg']} into torch's hub cache")
    from torchmetrics.functional.image import dists
    from torchvision.models import vgg16

    def empty_vgg16(weights: object) -> nn.Module:
        with torch.device("meta"):
            return vgg16(weights=None)

    backbone = _cached_backbone("vgg")
    # It would have torchvision unpickle the backbone from the cache, which runs what is in it.
    with patch.object(dists, "vgg16", empty_vgg16):
        network = dists.DISTSNetwork().eval()
    _fill_backbone(network, *backbone)

    return _distance_by(network)


def _distance_by(network: Callable[..., Tensor]) -> Distance:
    """The network's answer, computed on the CPU, for images that must lie in [0, 1]."""

    @torch.no_grad()
    def distance(
        prediction: Float[Tensor, "b 3 h w"], truth: Float[Tensor, "b 3 h w"]
    ) -> Float[Tensor, " b"]:
        for images in (prediction, truth):
            require_unit_range(images)
        return network(prediction.cpu(), truth.cpu()).flatten()

    return distance


def _cached_backbone(net: str) -> tuple[WeightFile, dict[str, Tensor]]:
    """The backbone in torch's hub cache, as torchvision saved it.

    InputError if the file is not the one that its name promises, or cannot be read.
    """
    name = BACKBONES[net]
    file = WeightFile(hub_cache() / name, None, f"download {_DOWNLOADS}/{name} again")
    file.require_digest(name.rpartition("-")[2].partition(".")[0])
    return file, file.tensors(file.read())


def _fill_backbone(network: nn.Module, file: WeightFile, saved: dict[str, Tensor]) -> None:
    """Give LPIPS's or DISTS's network its backbone; the other weights stay."""
    state = network.state_dict()
    for own in list(state):
        if layer := _CONVOLUTION.match(own):
            del state[own]
            if (key := f"features.{layer['layer']}.{layer['kind']}") in saved:
                state[own] = saved[key]
    file.fill(network, state)


def hub_cache() -> Path:
    """Where torchvision looks for backbones before it would download them."""
    return Path(torch.hub.get_dir()) / "checkpoints"
