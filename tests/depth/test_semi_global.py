import itertools

import numpy as np
import pytest
import torch

from extrap_train.depth.plane_sweep import (
    EDGE_CONTRAST,
    JUMP,
    SMALL_STEP,
    semi_global_cost,
    semi_global_torch,
)


def pixel_by_pixel(cost: np.ndarray, image: np.ndarray) -> np.ndarray:
    """The recursion as Hirschmüller writes it (2008, eq. 13)."""
    planes, height, width = cost.shape
    total = np.zeros_like(cost)
    for dv, du in set(itertools.product((-1, 0, 1), repeat=2)) - {(0, 0)}:
        path = np.zeros_like(cost)
        for v in range(height)[:: -1 if dv < 0 else 1]:
            for u in range(width)[:: -1 if du < 0 else 1]:
                path[:, v, u] = cost[:, v, u]
                before = (v - dv, u - du)
                if not (0 <= before[0] < height and 0 <= before[1] < width):
                    continue
                last = path[(slice(None), *before)]
                contrast = np.abs(image[:, v, u] - image[(slice(None), *before)]).mean()
                jump = max(JUMP / (1 + contrast / EDGE_CONTRAST), 1.5 * SMALL_STEP)
                for d in range(planes):
                    near = [last[e] + SMALL_STEP for e in (d - 1, d + 1) if 0 <= e < planes]
                    path[d, v, u] += min(last[d], last.min() + jump, *near) - last.min()
        total += path
    return total / 8


@pytest.mark.parametrize("summed", [semi_global_cost, semi_global_torch])
def test_equals_the_recursion_pixel_by_pixel(summed):
    generator = torch.Generator().manual_seed(1)
    cost = torch.rand(5, 6, 7, generator=generator)
    image = torch.rand(3, 6, 7, generator=generator) * 0.2
    expected = pixel_by_pixel(cost.double().numpy(), image.double().numpy())
    torch.testing.assert_close(
        summed(cost, image), torch.from_numpy(expected).float(), atol=1e-5, rtol=0
    )


def test_a_textureless_patch_takes_its_surroundings_depth():
    cost = torch.full((8, 20, 20), 0.5)
    cost[3] = 0.0
    cost[:, 8:12, 8:12] = 0.5
    assert (semi_global_cost(cost, torch.zeros(3, 20, 20)).argmin(0) == 3).all()
