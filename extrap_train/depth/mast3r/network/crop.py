"""A picture as the network sees it: resampled, then cropped to multiples of its patch."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.errors import InputError
from extrap_train.views import View


@dataclass(frozen=True)
class Crop:
    """How a view becomes the network's: resampled, then cropped around its middle."""

    resized: tuple[int, int]
    """(height, width) before the crop."""
    top: int
    left: int
    height: int
    width: int

    def apply(self, view: View) -> View:
        """The network's view; its camera sees what the crop shows."""
        return view.resized(*self.resized).cropped(self.top, self.left, self.height, self.width)


def crop_for(view: View, image_size: int, patch: int, square: bool, option: str = "depth") -> Crop:
    """The longer side becomes `image_size`, both are cut to multiples of `patch`.

    Unless `square`, a square picture is cut to 4:3, the squarest shape that the published networks
    of 512 pixels know. InputError where a picture is too narrow for a single patch; `option` is
    what `image_size` is an option of.
    """
    scale = image_size / max(view.camera.height, view.camera.width)
    resized = round(view.camera.height * scale), round(view.camera.width * scale)
    height, width = (side // patch * patch for side in resized)
    if height == width and not square:
        height = max(height * 3 // 4 // patch, 1) * patch
    if not height or not width:
        raise InputError(
            f"{view.name or 'a view'}: {view.camera.height} x {view.camera.width} pixels are too "
            f"narrow for {option}.image_size={image_size}, at which a side has under {patch}"
        )
    return Crop(resized, (resized[0] - height) // 2, (resized[1] - width) // 2, height, width)


def network_input(view: View, device: torch.device) -> Float[Tensor, "1 3 h w"]:
    """Colours as the network wants them, in [−1, 1]."""
    return (view.image[None].to(device) - 0.5) / 0.5
