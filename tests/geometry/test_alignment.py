"""Alignment against exact answers and against gradient descent over the same edges."""

from dataclasses import replace

import pytest
import torch

from benchmarks.perf.align_timing import NOISES, align_by_descent, bumpy_edges, relative_error
from extrap_train.geometry.alignment import align_view
from extrap_train.views import Camera


def test_exact_point_maps_give_the_exact_depth_whatever_frame_and_unit_each_edge_has():
    camera, depth, edges = bumpy_edges(48, NOISES["clean"])
    result = align_view(camera, edges)
    assert relative_error(result.depth, depth) < 1e-5
    assert (result.depth / depth - 1).abs().max() < 1e-4
    assert result.usable.all()
    known = edges.known_points @ result.edge_to_world[:, :3, :3].mT
    known = known + result.edge_to_world[:, None, :3, 3]
    assert torch.allclose(known, edges.world_points, atol=1e-4)


def test_rounding_of_exact_point_maps_is_no_disagreement():
    camera, _, edges = bumpy_edges(48, NOISES["clean"])
    assert align_view(camera, edges).confidence.min() > 0.999


@pytest.mark.parametrize("name", [name for name in NOISES if name != "clean"])
def test_no_worse_than_gradient_descent(name):
    camera, depth, edges = bumpy_edges(40, NOISES[name])
    ours = relative_error(align_view(camera, edges).depth, depth)
    descended = relative_error(align_by_descent(camera, edges, steps=150), depth)
    assert ours <= descended
    assert ours < 0.012


@pytest.mark.parametrize("unit", [1e-4, 1e4])
def test_unit_of_the_world_does_not_matter(unit):
    camera, depth, edges = bumpy_edges(40, NOISES["outliers 20%"])
    plain = align_view(camera, edges).depth
    world_to_cam = camera.world_to_cam.clone()
    world_to_cam[:3, 3] *= unit
    scaled = Camera(world_to_cam, camera.intrinsics, camera.height, camera.width)
    depth = align_view(scaled, replace(edges, world_points=edges.world_points * unit)).depth
    # The few pixels in which an outlier lies at a kernel's rim may fall to its other side.
    assert (depth / unit / plain - 1).abs().quantile(0.95) < 1e-3


def test_one_wrong_edge_among_six_is_outvoted():
    camera, depth, edges = bumpy_edges(48, NOISES["noisy 1%"])
    points = edges.new_points.clone()
    points[2] *= 1.3
    plain = relative_error(align_view(camera, edges).depth, depth)
    wrong = align_view(camera, replace(edges, new_points=points))
    assert relative_error(wrong.depth, depth) < 1.3 * plain
    clean = align_view(camera, edges)
    assert wrong.confidence.mean() < clean.confidence.mean()


def test_what_is_unknown_is_left_out():
    camera, depth, edges = bumpy_edges(48, NOISES["clean"])
    confidence = edges.new_confidence.clone()
    confidence[:, :10] = 0
    confidence[1:, 10:20] = 0
    known = edges.world_known.clone()
    known[0] = False
    known[1, ::2] = False
    points = edges.known_points.clone()
    points[1, ::2] = torch.nan
    result = align_view(
        camera,
        replace(edges, new_confidence=confidence, world_known=known, known_points=points),
    )
    assert result.usable.tolist() == [False] + [True] * 5
    assert not result.depth[:20].any()
    assert not result.confidence[:20].any()
    assert relative_error(result.depth[20:], depth[20:]) < 1e-5


def test_without_any_usable_edge_nothing_is_known():
    camera, _, edges = bumpy_edges(32, NOISES["clean"])
    result = align_view(camera, replace(edges, world_known=edges.world_known & False))
    assert not result.usable.any()
    assert not result.depth.any()
    assert not result.confidence.any()
