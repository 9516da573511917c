"""Synthetic scenes: what is drawn, and from where."""

from functools import cache

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from extrap_train.data.synthetic import (
    DENSE_POINTS,
    build_scene,
    handheld_orbit,
    render,
    surface_points,
)
from extrap_train.data.synthetic.categories import NAMES as CATEGORIES
from extrap_train.data.synthetic.shapes import move_mesh
from extrap_train.errors import InputError
from extrap_train.geometry.cameras import project

scene_of = cache(build_scene)
"""Scenes are not changed by what looks at them."""


def object_vertices(scene):
    parts = [part for part in scene.parts if part.is_object]
    return np.concatenate([move_mesh(part.mesh, part.part_to_world).vertices for part in parts])


@pytest.mark.parametrize("count", [4, pytest.param(20, marks=pytest.mark.slow)])
@pytest.mark.parametrize("category", CATEGORIES)
def test_every_object_is_sound_and_stands_on_the_ground(category, count):
    for index in range(count):
        scene = scene_of(category, index, 0)
        vertices = object_vertices(scene)
        assert np.isfinite(scene.mesh.vertices).all()
        np.testing.assert_allclose(np.linalg.norm(scene.mesh.normals, axis=1), 1, atol=1e-6)
        assert len(scene.mesh.faces) <= 20_000
        np.testing.assert_allclose(vertices[:, 2].min(), 0, atol=1e-9)
        np.testing.assert_allclose((vertices.max(0) - vertices.min(0)).max(), 1, atol=1e-9)
        a, b, c = (scene.mesh.vertices[scene.mesh.faces[:, i]] for i in range(3))
        assert np.linalg.norm(np.cross(b - a, c - a), axis=1).min() > 0


@pytest.mark.parametrize("category", CATEGORIES)
def test_the_walk_closes_the_circle_and_keeps_the_object_in_frame(category):
    for index in range(4):
        scene = scene_of(category, index, 0)
        cameras = handheld_orbit(scene, frames=24, image_size=64, seed=index)
        offsets = cameras.center.numpy() - scene.look_at
        azimuths = np.sort(np.arctan2(offsets[:, 1], offsets[:, 0]))
        gaps = np.diff(azimuths, append=azimuths[0] + 2 * np.pi)
        assert np.rad2deg(gaps.max()) < 30
        elevations = np.rad2deg(np.arcsin(offsets[:, 2] / np.linalg.norm(offsets, axis=1)))
        assert elevations.min() > 21
        assert elevations.max() < 51
        points = torch.from_numpy(object_vertices(scene)).float().expand(24, -1, -1)
        pixels, depth = project(points, cameras)
        assert (depth > 0).all()
        assert pixels.min() >= 0
        assert pixels.max() <= 64


def test_a_scene_follows_from_its_number_alone():
    def picture(index, seed):
        scene = build_scene("cup", index, seed)
        return render(scene, handheld_orbit(scene, 4, 24, seed=3)[1])

    first, again = picture(2, 0), picture(2, 0)
    assert torch.equal(first.image, again.image)
    assert torch.equal(first.depth, again.depth)
    assert not torch.equal(first.image, picture(3, 0).image)
    assert not torch.equal(first.image, picture(2, 1).image)


@pytest.mark.parametrize("category", CATEGORIES)
def test_objects_of_a_category_differ_in_shape_and_colour(category):
    scenes = [scene_of(category, index, 0) for index in range(4)]
    assert len({scene.radius for scene in scenes}) == 4
    colors = []
    for scene in scenes:
        view = render(scene, handheld_orbit(scene, 1, 32, seed=0)[0], supersample=1)
        colors.append(view.image[:, view.mask > 0].mean(1))
    assert torch.pdist(torch.stack(colors)).max() > 0.1


def test_an_unknown_category_is_answered_with_the_known_ones():
    with pytest.raises(InputError, match=f"'toaster'; there are {', '.join(CATEGORIES)}"):
        build_scene("toaster", 0, 0)


def test_surface_points_lie_on_what_cameras_see():
    scene = build_scene("hydrant", 1, seed=0)
    cloud = surface_points(scene, 2000)
    assert cloud.points.shape == cloud.colors.shape == (2000, 3)
    assert cloud.colors.min() >= 0
    assert cloud.colors.max() <= 1
    camera = handheld_orbit(scene, 8, 128, seed=0)[3]
    view = render(scene, camera, supersample=1)
    pixels, depth = project(torch.from_numpy(cloud.points).float(), camera)
    inside = ((pixels > 0) & (pixels < 128)).all(1) & (depth > 0)
    column, row = pixels[inside].long().T
    behind = depth[inside] - view.depth[row, column]
    # No point floats in front of a surface, but pixels of the outline may show what is behind it.
    assert (behind > -0.03).float().mean() > 0.96
    assert (behind.abs() < 0.03).float().mean() > 0.5


@pytest.mark.parametrize("category", ["apple", "chair"])  # ground of large and of small triangles
def test_dense_points_leave_no_gap_in_which_a_right_point_would_count_as_wrong(category: str):
    scene = build_scene(category, 4, seed=0)
    sparse, dense = surface_points(scene, 4000), surface_points(scene, DENSE_POINTS)
    height = np.ptp(dense.points[dense.is_object], axis=0).max()
    near = np.linalg.norm(sparse.points, axis=1) < 1
    apart = cKDTree(dense.points).query(sparse.points[near])[0]
    assert (apart < 0.02 * height).mean() > 0.999
    assert 0.3 < dense.is_object.mean() < 0.7
