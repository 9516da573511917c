"""The renderer against closed forms and an independent ray caster."""

import numpy as np
import pytest
import torch

from extrap_train.data.synthetic import build_scene, handheld_orbit, render
from extrap_train.data.synthetic.material import (
    LocalPoints,
    Material,
    Mottled,
    Plain,
    linear_to_srgb,
    srgb_to_linear,
)
from extrap_train.data.synthetic.parts import Light, Part, SyntheticScene, placement
from extrap_train.data.synthetic.shapes import ellipsoid, flat_ground
from extrap_train.geometry.cameras import project, unproject_to_world

WHITE = Material(Plain(np.full(3, 0.5)))


def ball_on_a_plane(segments: int) -> SyntheticScene:
    """A ball of radius 0.5 on the ground; the sun right above is the only light."""
    none, sun = np.zeros(3, np.float32), np.full(3, 0.6, np.float32)
    light = Light(np.array([0, 0, 1], np.float32), sun, sky=none, ground=none)
    ball = Part(ellipsoid((0.5,) * 3, segments), WHITE, placement((0, 0, 0.5)))
    ground = Part(flat_ground((30, 30)), WHITE, is_object=False, casts_shadow=False)
    return SyntheticScene("ball", (ball, ground), light, np.array([0, 0, 0.5]), 0.5)


@pytest.fixture(scope="module")
def hydrant_views():
    scene = build_scene("hydrant", 0, seed=0)
    cameras = handheld_orbit(scene, frames=24, image_size=96, seed=0)
    return scene, [render(scene, cameras[i]) for i in (0, 1)]


def test_depth_of_ball_and_plane_is_that_of_the_pixel_centres_ray():
    scene = ball_on_a_plane(segments=256)
    camera = handheld_orbit(scene, 6, 64, seed=1)[2]
    view = render(scene, camera)
    points = unproject_to_world(view.depth.double(), camera_in_double(camera)).numpy()
    on_ball = view.mask.numpy() > 0
    radii = np.linalg.norm(points[on_ball] - [0, 0, 0.5], axis=1)
    np.testing.assert_allclose(radii, 0.5, atol=2e-4)
    np.testing.assert_allclose(points[~on_ball & (view.depth.numpy() > 0)][:, 2], 0, atol=2e-5)


def camera_in_double(camera):
    return type(camera)(
        camera.world_to_cam.double(), camera.intrinsics.double(), camera.height, camera.width
    )


def test_depth_equals_an_independent_ray_casters(hydrant_views):
    scene, (view, _) = hydrant_views
    camera = camera_in_double(view.camera)
    rows, columns = np.random.default_rng(0).integers(0, 96, (2, 40))
    ahead = unproject_to_world(torch.ones(96, 96).double(), camera)[rows, columns].numpy()
    origin = camera.center.numpy()
    depth = [first_hit(scene.mesh, origin, point - origin) for point in ahead]
    np.testing.assert_allclose(view.depth[rows, columns], depth, rtol=1e-4)


def first_hit(mesh, origin, direction):
    """Möller and Trumbore (1997) in double precision, over all triangles at once."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    p = np.cross(direction, c - a)
    determinant = ((b - a) * p).sum(1)
    with np.errstate(divide="ignore", invalid="ignore"):
        u = ((origin - a) * p).sum(1) / determinant
        q = np.cross(origin - a, b - a)
        v = (q * direction).sum(1) / determinant
        t = (q * (c - a)).sum(1) / determinant
    return t[(u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)].min()


def test_the_mask_is_where_the_object_is_the_first_surface(hydrant_views):
    scene, (view, _) = hydrant_views
    assert 0.05 < view.mask.mean() < 0.6
    points = unproject_to_world(view.depth, view.camera)[view.mask > 0].numpy()
    assert np.linalg.norm(points - scene.look_at, axis=1).max() <= scene.radius + 1e-3


def test_depth_of_one_view_predicts_the_next(hydrant_views):
    _, (first, second) = hydrant_views
    points = unproject_to_world(first.depth, first.camera).reshape(-1, 3)
    pixels, depth = project(points, second.camera)
    inside = ((pixels > 0) & (pixels < 96)).all(1) & (depth > 0)
    column, row = pixels[inside].long().T
    seen = second.depth[row, column]
    visible = depth[inside] < seen * 1.01
    assert visible.float().mean() > 0.8
    error = (depth[inside] - seen).abs()[visible] / seen[visible]
    assert error.median() < 0.005
    colors = first.image.reshape(3, -1)[:, inside]
    difference = (colors - second.image[:, row, column]).abs().mean(0)[visible]
    assert difference.median() < 0.05  # the world keeps its colours when the camera moves


def test_the_sun_lights_the_plane_and_the_ball_shadows_it():
    scene = ball_on_a_plane(segments=32)
    view = render(scene, handheld_orbit(scene, 6, 64, seed=1)[2])
    points = unproject_to_world(view.depth, view.camera).numpy()
    ground = view.mask.numpy() == 0
    across = np.hypot(points[..., 0], points[..., 1])
    lit, shadow = view.image.numpy()[:, ground & (across > 1)], ground & (across < 0.45)
    expected = linear_to_srgb(np.full(3, 0.5 * 0.6))[0]
    assert (np.abs(lit - expected) < 0.005).mean() > 0.95  # all but the ball's outline
    assert shadow.any()
    assert view.image.numpy()[:, shadow].max() == 0


def test_srgb_round_trip():
    encoded = np.linspace(0, 1, 33)[:, None].repeat(3, 1)
    np.testing.assert_allclose(linear_to_srgb(srgb_to_linear(encoded)), encoded, atol=1e-12)


def test_textures_finer_than_a_pixel_fade_to_their_mean():
    rng = np.random.default_rng(0)
    points = rng.uniform(-5, 5, (4000, 3)).astype(np.float32)
    texture = Mottled(np.zeros(3), np.ones(3), frequency=10.0, seed=1)

    def spread(footprint):
        surface = LocalPoints(points, points, np.full(len(points), footprint, np.float32))
        return texture(surface).std()

    assert spread(0.0) > 0.15
    assert spread(1.0) == 0
