"""An update of the averaged weights at full size, against torch's own average with a function per
tensor.
"""

import time
from copy import deepcopy

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel, get_ema_avg_fn

from benchmarks.perf.diffusion_case import configuration
from benchmarks.perf.timing import Timing, compare, devices
from extrap_train.diffusion.averaging import AveragedModule
from extrap_train.diffusion.model import ExtrapolationModel

FULL_WIDTH = 320
DECAY = 0.05
"""Below the growing memory's, so that both are plain averages from the second update on."""
_REPEATS = 5


def run() -> list[Timing]:
    """One row per device; on the CPU the seconds of a core, too."""
    return [compare_averages(FULL_WIDTH, device) for device in devices()]


def compare_averages(width: int, device: torch.device, repeats: int = _REPEATS) -> Timing:
    """The denoiser's tensors, `width` channels at its finest level; three times in memory."""
    unet = unet_weights(width, device)
    ours = AveragedModule(deepcopy(unet), device, DECAY)
    theirs = AveragedModel(unet, avg_fn=get_ema_avg_fn(DECAY), use_buffers=True)
    for average in (ours, theirs):
        average.update_parameters(unet)
    for weight in unet.parameters():
        weight.data.add_(1)

    def update(average: AveragedModel) -> Float[Tensor, " n"]:
        average.update_parameters(unet)
        return torch.stack([weight.detach().flatten()[0] for weight in average.module.parameters()])

    row = compare(
        f"average of {sum(x.numel() for x in unet.parameters()) / 1e6:.0f} million weights",
        device,
        lambda: update(ours),
        lambda: update(theirs),
        repeats,
    )
    started = time.process_time()
    update(ours)
    print(f"{row.case}, {device.type}: {time.process_time() - started:.2f} s of a core an update")
    return row


def unet_weights(width: int, device: torch.device) -> nn.Module:
    """The denoiser with arbitrary weights, as many as that width has."""
    with torch.device("meta"):
        unet = ExtrapolationModel(configuration(width)).unet
    unet = unet.to_empty(device=device)
    for weight in unet.parameters():
        weight.data.fill_(0.5)
    return unet
