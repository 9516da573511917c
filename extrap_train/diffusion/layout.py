"""How a model's weights lie in memory where it trains or paints."""

import torch

from extrap_train.diffusion.model import ExtrapolationModel


def arranged(model: ExtrapolationModel) -> ExtrapolationModel:
    """The model with every network's convolutions channels last, the frozen ones', too.

    The results are the same but for rounding. docs/performance.md has what it brings.
    """
    for network in model.parts().values():
        network.to(memory_format=torch.channels_last)
    return model
