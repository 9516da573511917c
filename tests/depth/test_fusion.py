import numpy as np
import torch

from extrap_train.depth import DepthMap
from extrap_train.depth.mast3r.source import fuse_depth_maps, weighted_median


def estimate(depth: float, confidence: float) -> DepthMap:
    return DepthMap(torch.full((2, 3), depth), torch.full((2, 3), confidence))


def test_weighted_median_is_that_of_repeated_values():
    generator = np.random.default_rng(0)
    values = generator.normal(size=(5, 40))
    counts = generator.integers(0, 4, size=(5, 40))
    counts[0] += counts.sum(0) == 0
    found = weighted_median(torch.from_numpy(values), torch.from_numpy(counts).double())
    for column in range(40):
        repeated = np.sort(np.repeat(values[:, column], counts[:, column]))
        assert found[column] == repeated[(len(repeated) - 1) // 2]


def test_one_estimate_stays_as_it_is():
    generator = torch.Generator().manual_seed(0)
    depth, confidence = torch.rand(2, 4, 5, generator=generator)
    depth[1, 2], confidence[3, 3] = 0, 0
    found = fuse_depth_maps([DepthMap(depth, confidence)])
    known = (depth > 0) & (confidence > 0)
    torch.testing.assert_close(found.depth, torch.where(known, depth, 0))
    torch.testing.assert_close(found.confidence, torch.where(known, confidence, 0))


def test_an_outlier_is_outvoted_and_costs_confidence():
    found = fuse_depth_maps([estimate(2.0, 0.8), estimate(2.02, 0.8), estimate(5.0, 0.9)])
    assert torch.all((found.depth - 2.01).abs() < 1e-3)
    torch.testing.assert_close(found.confidence, torch.full((2, 3), 0.8 * 1.6 / 2.5))


def test_the_unknown_has_no_say():
    found = fuse_depth_maps([estimate(0.0, 0.9), estimate(3.0, 0.5)])
    torch.testing.assert_close(found.depth, torch.full((2, 3), 3.0))
    torch.testing.assert_close(found.confidence, torch.full((2, 3), 0.5))
    nothing = fuse_depth_maps([estimate(0.0, 0.9), estimate(3.0, 0.0)])
    assert not nothing.depth.any()
    assert not nothing.confidence.any()
