"""Queries get their nearest views, at the model's size, and bad poses are refused."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from orbits import even, looking_at, ring

from extrap_train.data.examples import query_batch
from extrap_train.errors import InputError
from extrap_train.geometry.viewpoints import references_by_nearness
from extrap_train.views import Camera, View


def views_on(cameras: Camera) -> list[View]:
    count, height, width = len(cameras.world_to_cam), cameras.height, cameras.width
    images = torch.rand(count, 3, height, width, generator=torch.Generator().manual_seed(0))
    depth = torch.full((height, width), 3.0)
    return [View(images[i], cameras[i], depth, name=f"view{i}") for i in range(count)]


def test_nearest_views_come_first():
    batch, chosen = query_batch(
        views_on(ring(even(6))), ring(np.array([65.0, 350.0])), most_references=3, size=16
    )
    assert chosen == [(1, 2, 0), (0, 5, 1)]
    assert batch.reference_images.shape == (2, 3, 3, 16, 16)
    assert batch.reference_valid.all()
    assert batch.image.isnan().all(), "nobody has photographed the query"


def test_fewer_views_than_references_leave_places_invalid():
    batch, chosen = query_batch(views_on(ring(even(6))[:1]), ring(np.array([30.0])), 3, 16)
    assert chosen == [(0,)]
    assert batch.reference_valid.tolist() == [[True, False, False]]


def test_parallel_cameras_are_ordered_by_distance():
    beside = np.array([[0.0, 0, 0], [5, 0, 0], [1, 0, 0]])
    references = looking_at(beside, beside + np.array([0.0, 10.0, 0.0]))
    queries = looking_at(np.array([[1.2, 0, 0]]), np.array([[1.2, 10.0, 0]]))
    assert references_by_nearness(references, queries).tolist() == [[2, 0, 1]]


def test_a_query_keeps_its_field_of_view_at_the_models_size():
    """512 pixels with another lens than the views': only the number of pixels changes."""
    wide = replace(ring(np.array([20.0])), height=512, width=512)
    wide.intrinsics[:, 0, 0] = wide.intrinsics[:, 1, 1] = 300.0
    wide.intrinsics[:, :2, 2] = 256.0
    batch, _ = query_batch(views_on(ring(even(3))), wide, 3, 16)
    focal = float(batch.camera.intrinsics[0, 0, 0])
    assert 2 * np.arctan(8 / focal) == pytest.approx(2 * np.arctan(256 / 300), rel=1e-6)
    assert float(batch.reference_cameras.intrinsics[0, 0, 0, 0]) == pytest.approx(60 * 16 / 48)


def test_a_degenerate_pose_is_named():
    queries = ring(even(3))
    queries.world_to_cam[1, 0, 3] = torch.nan
    with pytest.raises(InputError, match=r"query 1: its camera is degenerate \(NaN"):
        query_batch(views_on(ring(even(3))), queries, 3, 16)
    views = views_on(ring(even(3)))
    views[2].camera.world_to_cam[:3, :3] *= 2
    with pytest.raises(InputError, match="view view2: its camera is degenerate"):
        query_batch(views, ring(even(3)), 3, 16)


def test_views_without_depth_and_no_views_at_all_are_refused():
    flat = [replace(view, depth=None) for view in views_on(ring(even(3)))]
    with pytest.raises(InputError, match="view0: has no depth; use depth=stereo"):
        query_batch(flat, ring(even(3)), 3, 16)
    with pytest.raises(InputError, match="no view to start from"):
        query_batch([], ring(even(3)), 3, 16)
