"""A network that is used and never trained."""

import copy
from typing import Any

from torch import Tensor, nn


class Frozen:
    """Base of what wraps a pretrained network without making it a part of the trained model.

    Not a module on purpose: optimiser, averaged copy, DDP and checkpoints of a run then know
    nothing of it, which at full size saves gigabytes, and it follows its input to any device.
    """

    def __init__(self, network: nn.Module) -> None:
        self.network: Any = network.requires_grad_(False).eval()

    def __deepcopy__(self, memo: dict[int, Any]) -> "Frozen":
        """One network for every copy of the model: nobody changes its weights."""
        return copy.copy(self)

    def _at(self, image: Tensor) -> Tensor:
        """The image in the network's precision, with the network on the image's device."""
        weight = next(self.network.parameters())
        if weight.device != image.device:
            self.network.to(image.device)
        return image.to(weight.dtype)
