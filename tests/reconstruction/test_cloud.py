"""Points between pixels: on one surface, never across a step in depth."""

import pytest
import scenes
import torch

from extrap_train.geometry.cameras import project
from extrap_train.reconstruction.cloud import cloud_of
from extrap_train.reconstruction.global_map import GIVEN, GlobalMap, Origin
from extrap_train.views import View

_SIZE = 16


def _depths_seen(step: float, subdivide: int) -> torch.Tensor:
    """Depths of the cloud of two planes that face the camera, the right one farther by `step`."""
    camera = scenes.orbit_camera(0.0, size=_SIZE)
    depth = torch.full((_SIZE, _SIZE), 2.0)
    depth[:, _SIZE // 2 :] = 2 + step
    view = View(torch.rand(3, _SIZE, _SIZE), camera, depth)
    known, _ = GlobalMap(0.01).added(view, torch.ones_like(depth), Origin(GIVEN, root=0))
    return project(cloud_of(known, subdivide=subdivide).points, camera)[1]


@pytest.mark.parametrize("step", [0.15, 0.5, 5.0])
def test_no_point_lies_across_a_step_in_depth(step: float) -> None:
    depths = _depths_seen(step, subdivide=3)
    on_a_plane = (depths - 2).abs().minimum((depths - 2 - step).abs())
    assert on_a_plane.max() < 1e-4
    assert len(depths) > 2 * len(_depths_seen(step, subdivide=1))


def test_a_surface_that_bends_a_little_is_closed() -> None:
    depths = _depths_seen(0.05, subdivide=2)
    assert ((depths - 2.025).abs() < 1e-4).any()
