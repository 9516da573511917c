"""Images at other places and sizes, and without holes."""

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from extrap_train.views import SAME_SURFACE, PairBatch, Warp, send

_LOBES = 3


def sample_pixels(
    planes: Float[Tensor, "c h w"], pixels: Float[Tensor, "*n 2"]
) -> Float[Tensor, "c ..."]:
    """Bilinear samples at (u, v), centres at +0.5; outside the image those of its border."""
    size = pixels.new_tensor([planes.shape[2], planes.shape[1]])
    at = (pixels / size * 2 - 1).reshape(1, 1, -1, 2)
    found = functional.grid_sample(planes[None], at, padding_mode="border", align_corners=False)
    return found.reshape(len(planes), *pixels.shape[:-1])


def sample_surfaces(
    maps: Float[Tensor, "c h w"], pixels: Float[Tensor, "*n 2"]
) -> Float[Tensor, "c ..."]:
    """A depth map, the first of `maps`, and what lies on its surfaces, at (u, v).

    Interpolated on a surface, by the nearest pixel at its edges, like `views.resample_surfaces`.
    """
    last = pixels.new_tensor([maps.shape[2] - 1, maps.shape[1] - 1])
    u, v = pixels.clamp_min(0).floor().minimum(last).long().unbind(-1)
    nearest, smooth = maps[:, v, u], sample_pixels(maps, pixels)
    same = (smooth[0] - nearest[0]).abs() < SAME_SURFACE * nearest[0]
    return torch.where(same, smooth, nearest)


def lanczos_resize(
    image: Float[Tensor, "*b h w"], height: int, width: int
) -> Float[Tensor, "*b height width"]:
    """The image resampled by a Lanczos-3 kernel as wide as the coarser of the two grids.

    Pillow's `LANCZOS` without its rounding to 8 bits; values may over- and undershoot.
    """
    rows = send(_weights(image.shape[-2], height), image)
    columns = send(_weights(image.shape[-1], width), image)
    return rows @ image @ columns.mT


def _weights(source: int, target: int) -> Float[Tensor, "target source"]:
    """Row by row what each target pixel takes of every source pixel; rows sum to 1."""
    scale = source / target
    stretch = max(scale, 1.0)
    centers = (torch.arange(target, dtype=torch.float64) + 0.5) * scale
    offsets = (torch.arange(source, dtype=torch.float64) + 0.5 - centers[:, None]) / stretch
    kernel = torch.sinc(offsets) * torch.sinc(offsets / _LOBES) * (offsets.abs() < _LOBES)
    return kernel / kernel.sum(1, keepdim=True)


_COARSEST_CELLS = 16
"""On the shorter side of the coarsest level, about.

Measured on held-out views: what lies beyond a hole wider than 1/16 of the picture is rather like
the picture's mean than like the hole's rim, which is mostly the object's.
"""


def fill_holes(
    image: Float[Tensor, "b c h w"], mask: Float[Tensor, "b h w"]
) -> Float[Tensor, "b c h w"]:
    """Fill where `mask` is 0: narrow holes from their rim, wide ones with the mean of the known.

    Pull-push (Gortler et al., The Lumigraph, 1996, section 3.4.1) down to `_COARSEST_CELLS` a side:
    known pixels are averaged level by level, and each hole takes the finest level's colour that
    reaches it. Known pixels stay exactly as they are; an image without any becomes 0.
    """
    weight = mask[:, None].to(image.dtype)
    total = weight.sum((-2, -1), keepdim=True).clamp_min(1e-8)
    mean = (image * weight).sum((-2, -1), keepdim=True) / total
    levels = max(0, round(math.log2(min(image.shape[-2:]) / _COARSEST_CELLS)))
    return _pull_push(image, weight, mean, levels)


def _pull_push(
    image: Float[Tensor, "b c h w"],
    weight: Float[Tensor, "b 1 h w"],
    mean: Float[Tensor, "b c 1 1"],
    levels: int,
) -> Float[Tensor, "b c h w"]:
    if levels == 0:
        return torch.where(weight > 0, image, mean)
    height, width = image.shape[-2:]
    padded = (0, width % 2, 0, height % 2)
    colours = functional.avg_pool2d(functional.pad(image * weight, padded), 2)
    coverage = functional.avg_pool2d(functional.pad(weight, padded), 2)
    known = (coverage > 0).to(image.dtype)
    filled = _pull_push(colours / coverage.clamp_min(1e-8), known, mean, levels - 1)
    up = functional.interpolate(filled, scale_factor=2.0, mode="bilinear", align_corners=False)
    return torch.where(weight > 0, image, up[..., :height, :width])


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
