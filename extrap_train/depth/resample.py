"""Depth maps at another size."""

import torch

from extrap_train.depth import DepthMap
from extrap_train.views import resample_surfaces


def resampled(depth_map: DepthMap, height: int, width: int) -> DepthMap:
    """Interpolated on a surface, by the nearest pixel at its edges, so that none is invented."""
    if depth_map.depth.shape == (height, width):
        return depth_map
    both = torch.stack([depth_map.depth, depth_map.confidence])
    return DepthMap(*resample_surfaces(both, (height, width)))
