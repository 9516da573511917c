"""From the size that warps are made at to the smaller one that a model works at.

A warp tears where a surface is hit by less than a point per pixel. Made at twice the size and then
reduced, thin and grazing surfaces keep their pixels, as anti-aliasing keeps thin lines.
"""

from dataclasses import replace

from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from extrap_train.views import PairBatch, Warp


def reduce_batch(batch: PairBatch, factor: int) -> PairBatch:
    """The batch with everything in it, its warp too, at 1/`factor` of its size.

    Colours are averaged; depth, which has edges, is taken from one pixel in each block: the middle
    one, or half a fine pixel off the middle where `factor` is even. A block of which the object
    covers half is the object's.
    """
    if factor == 1:
        return batch
    size = (batch.camera.height // factor, batch.camera.width // factor)
    middle, mask = factor // 2, batch.object_mask
    return replace(
        batch,
        image=functional.avg_pool2d(batch.image, factor),
        camera=batch.camera.resized(*size),
        reference_images=functional.avg_pool2d(
            batch.reference_images.flatten(0, 1), factor
        ).unflatten(0, batch.reference_images.shape[:2]),
        reference_cameras=batch.reference_cameras.resized(*size),
        reference_depths=batch.reference_depths[..., middle::factor, middle::factor],
        object_mask=None if mask is None else functional.avg_pool2d(mask.float(), factor) >= 0.5,
        warp=None if batch.warp is None else reduce_warp(batch.warp, factor),
    )


def reduce_warp(warp: Warp, factor: int) -> Warp:
    """The warp at 1/`factor` of its size: each block is the mean of its known pixels.

    A block with at least one known pixel is known: what a reference reaches is rather shown
    coarsely than lost.
    """
    known = functional.avg_pool2d(warp.mask[:, None], factor)
    nearest = functional.avg_pool2d(warp.nearest_mask[:, None], factor)
    return Warp(
        image=_known_mean(warp.image, warp.mask, known, factor),
        coordinates=_known_mean(warp.coordinates, warp.nearest_mask, nearest, factor),
        depth=_known_mean(warp.depth[:, None], warp.mask, known, factor)[:, 0],
        weight=functional.avg_pool2d(warp.weight[:, None], factor)[:, 0],
        mask=(known > 0).to(warp.mask.dtype)[:, 0],
        nearest_mask=(nearest > 0).to(warp.mask.dtype)[:, 0],
    )


def _known_mean(
    values: Float[Tensor, "b c h w"],
    mask: Float[Tensor, "b h w"],
    share: Float[Tensor, "b 1 h2 w2"],
    factor: int,
) -> Float[Tensor, "b c h2 w2"]:
    """Mean of each block over the pixels where `mask` is 1; 0 where none is.

    `share` is the part of each block that is known.
    """
    total = functional.avg_pool2d(values * mask[:, None], factor)
    return total / share.clamp_min(1e-6)
