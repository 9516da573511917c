"""What a model has to beat: images of the query made from the references without any training."""

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.views import PairBatch, Warp

_TELEA_RADIUS = 3.0


def nearest_reference(batch: PairBatch) -> Float[Tensor, "b 3 h w"]:
    """The nearest photograph as it is."""
    return batch.reference_images[:, 0]


def inpainted_warp(warp: Warp) -> Float[Tensor, "b 3 h w"]:
    """The warp with its holes inpainted (Telea 2004)."""
    return torch.stack([_telea(i, m) for i, m in zip(warp.image, warp.mask, strict=True)])


def mean_filled_warp(warp: Warp) -> Float[Tensor, "b 3 h w"]:
    """The warp with its holes in the mean colour of what is known; mid-grey where nothing is."""
    known = warp.mask[:, None]
    count = known.sum((-2, -1), keepdim=True)
    mean = (warp.image * known).sum((-2, -1), keepdim=True) / count.clamp_min(1)
    return torch.where(known > 0, warp.image, torch.where(count > 0, mean, 0.5))


def _telea(image: Float[Tensor, "3 h w"], mask: Float[Tensor, "h w"]) -> Float[Tensor, "3 h w"]:
    pixels = (image * 255).round().byte().permute(1, 2, 0).cpu().numpy()
    holes = (mask == 0).byte().cpu().numpy()
    if holes.all():
        return torch.full_like(image, 0.5)
    painted = cv2.inpaint(np.ascontiguousarray(pixels), holes, _TELEA_RADIUS, cv2.INPAINT_TELEA)
    filled = torch.from_numpy(painted).permute(2, 0, 1).to(image) / 255
    return torch.where(mask > 0, image, filled)
