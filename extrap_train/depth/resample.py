"""Depth maps at another size."""

import torch
from torch.nn import functional

from extrap_train.depth import DepthMap

SAME_SURFACE = 0.02
"""Relative difference of depth below which a resampled map is interpolated."""


def resampled(depth_map: DepthMap, height: int, width: int) -> DepthMap:
    """Interpolated on a surface, by the nearest pixel at its edges, so that none is invented."""
    size = (height, width)
    if depth_map.depth.shape == size:
        return depth_map
    both = torch.stack([depth_map.depth, depth_map.confidence])[None]
    nearest = functional.interpolate(both, size, mode="nearest-exact")[0]
    smooth = functional.interpolate(both, size, mode="bilinear", align_corners=False)[0]
    same = (smooth[0] - nearest[0]).abs() < SAME_SURFACE * nearest[0]
    return DepthMap(
        torch.where(same, smooth[0], nearest[0]), torch.where(same, smooth[1], nearest[1])
    )
