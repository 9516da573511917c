"""The stand-in for monocular depth is an affine map of the source's, unknown and a view's own."""

import numpy as np
import pytest
import torch

from benchmarks.methods.threedgs import AffineSurrogate
from extrap_train.depth import DatasetDepth, DepthSource
from extrap_train.errors import InputError
from extrap_train.views import View
from tests.scenes import SPHERE, orbit_camera


def _view(azimuth: float) -> View:
    camera = orbit_camera(azimuth, size=32)
    return View(SPHERE.image(camera), camera, SPHERE.depth(camera))


def _map(view: View, depth: torch.Tensor) -> tuple[float, float, float]:
    known = view.depth > 0
    assert (depth[~known] == 0).all()
    a, b = view.depth[known].double().numpy(), depth[known].double().numpy()
    (scale, shift), residual, *_ = np.polyfit(a, b, 1, full=True)
    return scale, shift, float(residual[0])


def test_depth_is_affine_in_the_truth_with_a_map_for_each_view():
    views = [_view(0.0), _view(50.0)]
    source = AffineSurrogate(DatasetDepth(), seed=1)
    assert isinstance(source, DepthSource)
    maps = [_map(v, m.depth) for v, m in zip(views, source.depth_maps(views), strict=True)]
    for scale, shift, residual in maps:
        assert scale > 0
        assert shift > -1e-9
        assert residual < 1e-8
    assert abs(maps[0][1] - maps[1][1]) > 1e-3
    again = source.depth_map(views[1], views[:1]).depth
    assert _map(views[1], again) == maps[1]
    other = AffineSurrogate(DatasetDepth(), seed=2).depth_map(views[1], ()).depth
    assert not other.equal(again)


def test_two_views_have_no_scale_in_common():
    with pytest.raises(InputError, match="no scale"):
        AffineSurrogate(DatasetDepth()).point_maps(_view(0.0), _view(20.0))
