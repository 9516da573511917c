"""Depths that err view by view meet on the surface; photographs, and what all agree on, stay."""

import numpy as np
import scenes
import torch
from torch import Tensor

from extrap_train.reconstruction.fusion import fuse_depths
from extrap_train.reconstruction.global_map import GENERATED, GIVEN, GlobalMap, MapView, Origin
from extrap_train.views import View

SIZE = 48
SCENE = scenes.Scene((scenes.sphere(0.6), scenes.plane(0.6, (0.0, 1.0, 0.0))))
CAMERAS = [scenes.orbit_camera(angle_deg, size=SIZE) for angle_deg in range(0, 120, 15)]


def _map(*errors: float) -> GlobalMap:
    """Views whose depths are wrong by these shares; the first one is given."""
    known = GlobalMap(tolerance=0.01)
    for index, (camera, error) in enumerate(zip(CAMERAS, errors, strict=True)):
        view = View(SCENE.image(camera), camera, SCENE.depth(camera) * (1 + error))
        origin = Origin(GENERATED if index else GIVEN, root=0)
        known, _ = known.added(view, torch.full((SIZE, SIZE), 0.5 if index else 1.0), origin)
    return known


def _errors(views: tuple[MapView, ...]) -> Tensor:
    """Errors of the known depths of all the views."""
    errors = [(v.depth / SCENE.depth(v.camera) - 1).abs()[v.depth > 0] for v in views]
    return torch.cat(errors)


def _kept_share(before: MapView, after: MapView) -> float:
    return float((after.confidence > 0)[before.confidence > 0].float().mean())


def test_errors_of_single_views_cancel() -> None:
    errors = np.random.default_rng(0).permutation(np.linspace(-0.015, 0.015, len(CAMERAS) - 1))
    known = _map(0.0, *errors)
    fused = fuse_depths(known)
    assert _errors(fused.views[1:]).median() < 0.6 * _errors(known.views[1:]).median()
    assert torch.equal(fused.views[0].depth, known.views[0].depth)
    assert torch.equal(fused.views[0].confidence, known.views[0].confidence)


def test_depths_without_error_stay_up_to_resampling() -> None:
    known = _map(*[0.0] * len(CAMERAS))
    fused = fuse_depths(known)
    assert _errors(fused.views).quantile(0.9) < 0.015  # what the ground's changes by in a pixel
    assert all(_kept_share(*pair) > 0.98 for pair in zip(known.views, fused.views, strict=True))


def test_a_surface_that_all_others_look_through_is_no_surface() -> None:
    known = _map(0.0, 0.0, 0.0, -0.3, 0.0, 0.0, 0.0, 0.0)
    fused = fuse_depths(known)
    shares = [_kept_share(*pair) for pair in zip(known.views, fused.views, strict=True)]
    assert shares.pop(3) < 0.2
    assert min(shares) > 0.95


def test_a_view_alone_stays_as_it_is() -> None:
    known = _map(0.0, *[0.0] * (len(CAMERAS) - 1))
    alone = GlobalMap(known.tolerance, known.views[1:2])
    assert torch.allclose(fuse_depths(alone).views[0].depth, known.views[1].depth, rtol=1e-4)
