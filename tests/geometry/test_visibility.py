"""Unobserved space against closed forms and against ray-traced shadows."""

import math

import pytest
import scenes
import torch

from extrap_train.geometry.visibility import (
    SAMPLES,
    TOLERANCE,
    Ball,
    Visibility,
    trace_torch,
    trace_visibility,
)
from extrap_train.geometry.warp import warp_references
from extrap_train.views import Camera, stack_cameras

DISTANCE = 3.0
BALL = Ball(torch.zeros(1, 3), torch.tensor([1.5]))
STEP = 2 * 1.5 / SAMPLES


def reference(angle_deg, size=128):
    """A camera that holds the whole ball in view."""
    return scenes.orbit_camera(angle_deg, size=size, elevation_deg=0, focal=0.7)


def observe(scene, angles, size=128):
    cameras = [reference(angle, size) for angle in angles]
    depths = torch.stack([scene.depth(camera) for camera in cameras])
    return depths[None], stack_cameras([stack_cameras(cameras)])


def trace(scene, angles, query_deg, surface=None, size=128) -> tuple[Visibility, Camera]:
    depths, cameras = observe(scene, angles, size)
    query = scenes.orbit_camera(query_deg, size=64, elevation_deg=0)
    surface = scene.depth(query) if surface is None else surface
    valid = torch.ones(1, len(angles), dtype=torch.bool)
    seen = trace_visibility(depths, cameras, valid, stack_cameras([query]), surface[None], BALL)
    return seen, query


def center_of(image):
    """Mean of the four pixels around the optical axis."""
    return float(image[0, 31:33, 31:33].mean())


NOTHING = torch.zeros(64, 64)
SPHERE = scenes.Scene((scenes.sphere(0.8), scenes.plane(5.0)))
SHADOW_RADIUS = DISTANCE * math.tan(math.asin(0.8 / DISTANCE))
"""Radius of the sphere's shadow where the ray across it passes the centre."""


def test_behind_a_sphere_all_is_unobserved_up_to_its_front():
    seen, _ = trace(SPHERE, [0], 180, surface=NOTHING)
    assert center_of(seen.unobserved) == pytest.approx(1.5 + 0.8, abs=2 * STEP)
    assert center_of(seen.entry) == pytest.approx(DISTANCE - 1.5, abs=STEP)


def test_across_a_sphere_its_shadow_is_unobserved():
    seen, _ = trace(SPHERE, [0], 90, surface=NOTHING)
    assert center_of(seen.unobserved) == pytest.approx(2 * SHADOW_RADIUS, abs=3 * STEP)
    assert center_of(seen.entry) == pytest.approx(DISTANCE - SHADOW_RADIUS, abs=STEP)


def test_in_front_of_a_visible_surface_nothing_is_unobserved():
    seen, query = trace(SPHERE, [0], 0)
    # At its silhouette a ray may pass what the reference's larger pixel shows of the sphere.
    assert (seen.unobserved > 0).float().mean() < 0.05
    surface = SPHERE.depth(query)
    within = (surface > DISTANCE - 1.5) & (surface < DISTANCE)
    off = (seen.entry[0] / surface - 1)[within].abs()
    assert off.median() < 1.5 * TOLERANCE


@pytest.mark.parametrize("query_deg", [30, 70, 120, 180])
@pytest.mark.parametrize(
    "scene",
    [SPHERE, scenes.BOX_AND_PLANE, scenes.CARD_AND_PLANE],
    ids=["sphere", "box", "card"],
)
def test_unobserved_is_what_no_reference_reaches(scene, query_deg):
    """The oracle asks the scene itself whether the way from a reference to each point is free."""
    angles = [0, 40]
    seen, query = trace(scene, angles, query_deg, size=256)
    cameras = [reference(angle) for angle in angles]
    origins, directions = scenes.rays(query)
    surface = scene.depth(query).reshape(-1)
    length = torch.zeros(len(origins), dtype=torch.float64)
    fine = 2 * SAMPLES
    half_b, a = (origins * directions).sum(1), directions.square().sum(1)
    root = (half_b.square() - a * (origins.square().sum(1) - 1.5**2)).clamp(min=0).sqrt()
    start, stop = (-half_b - root) / a, (-half_b + root) / a
    for i in range(fine):
        depth = start + (i + 0.5) / fine * (stop - start)
        points = origins + depth[:, None] * directions
        free = torch.zeros(len(points), dtype=torch.bool)
        for camera in cameras:
            centre = camera.center.double().expand_as(points)
            free |= scene.hit(centre, points - centre) > 1
        counted = ~free & ((depth < surface) | (surface == 0))
        length += torch.where(counted, (stop - start) / fine * a.sqrt(), 0)
    error = (seen.unobserved[0].reshape(-1) - length).abs()
    assert error.mean() < STEP
    assert error.quantile(0.95) < 4 * STEP


def test_depth_that_is_unknown_shows_nothing_to_be_empty():
    seen, _ = trace(SPHERE, [0], 0, surface=NOTHING)
    depths, cameras = observe(SPHERE, [0])
    query = stack_cameras([scenes.orbit_camera(0, size=64, elevation_deg=0)])
    for hidden in (torch.zeros_like(depths), depths):
        valid = torch.full((1, 1), hidden is not depths)
        blind = trace_visibility(hidden, cameras, valid, query, NOTHING[None], BALL)
        assert center_of(blind.unobserved) == pytest.approx(2 * 1.5, abs=STEP)
        assert (blind.unobserved >= seen.unobserved).all()


def test_every_further_reference_leaves_less_unobserved():
    lengths = [trace(SPHERE, [0, 90, 200][:n], 140)[0].unobserved for n in (1, 2, 3)]
    assert (lengths[0] >= lengths[1]).all()
    assert (lengths[1] >= lengths[2]).all()
    assert lengths[0].mean() > lengths[2].mean()


def test_lengths_follow_the_unit_of_the_scene():
    depths, cameras = observe(SPHERE, [0, 40])
    query = scenes.orbit_camera(120, size=64, elevation_deg=0)
    surface, valid = SPHERE.depth(query)[None], torch.ones(1, 2, dtype=torch.bool)
    one = trace_visibility(depths, cameras, valid, stack_cameras([query]), surface, BALL)
    grown = stack_cameras([stack_cameras([scenes.scaled(cameras[0, k], 10) for k in range(2)])])
    ball = Ball(BALL.center, BALL.radius * 10)
    query = stack_cameras([scenes.scaled(query, 10)])
    ten = trace_visibility(depths * 10, grown, valid, query, surface * 10, ball)
    # A point on a pixel's border falls on either side of it with the rounding.
    assert ((ten.unobserved / 10 - one.unobserved).abs() > 1e-4).float().mean() < 0.02
    assert ((ten.entry / 10 - one.entry).nan_to_num(0).abs() > 1e-3).float().mean() < 0.02


def test_both_implementations_agree():
    depths, cameras = observe(scenes.BOX_AND_PLANE, [0, 40, -30])
    both = [scenes.orbit_camera(angle, size=48) for angle in (75, 160)]
    query, valid = stack_cameras(both), torch.ones(2, 3, dtype=torch.bool)
    depths = depths.expand(2, -1, -1, -1)
    cameras = stack_cameras([cameras[0], cameras[0]])
    surface = torch.stack([scenes.BOX_AND_PLANE.depth(camera) for camera in both])
    ball = Ball(torch.zeros(2, 3), torch.tensor([1.5, 1.0]))
    fast = trace_visibility(depths, cameras, valid, query, surface, ball)
    plain = trace_torch(depths, cameras, valid, query, surface, ball)
    # As above: rounding moves points over the borders of pixels.
    assert ((fast.unobserved - plain.unobserved).abs() > 1e-4).float().mean() < 0.01
    assert ((fast.entry - plain.entry).nan_to_num(0).abs() > 1e-3).float().mean() < 0.01
    assert (fast.entry.isinf() != plain.entry.isinf()).float().mean() < 0.01


@pytest.mark.parametrize("query_deg", [90, 120, 150])
def test_ground_seen_through_a_box_is_told_from_what_is_known(query_deg):
    box = scenes.box((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
    scene = scenes.Scene((box, scenes.plane(0.5, (0.0, 1.0, 0.0))))
    aside = [scenes.orbit_camera(angle, elevation_deg=25, focal=0.7) for angle in (0, 20, -20)]
    depths = torch.stack([scene.depth(camera) for camera in aside])[None]
    cameras = stack_cameras([stack_cameras(aside)])
    query = scenes.orbit_camera(query_deg, elevation_deg=25)
    valid = torch.ones(1, 3, dtype=torch.bool)
    images = torch.zeros(1, 3, 3, 128, 128)
    warp = warp_references(images, depths, cameras, valid, stack_cameras([query]))
    seen = trace_visibility(depths, cameras, valid, stack_cameras([query]), warp.depth, BALL)
    truth = scene.depth(query)
    on_box = torch.isfinite(scenes.Scene((box,)).hit(*scenes.rays(query))).reshape(truth.shape)
    on_box &= warp.mask[0] > 0
    wrong = on_box & (warp.depth[0] > 1.04 * truth)
    flagged = seen.unobserved[0] > 0.05 * DISTANCE
    assert wrong.sum() > 100
    assert (flagged & wrong).sum() / wrong.sum() > 0.9
    assert (flagged & on_box & ~wrong).sum() < 0.1 * (on_box & ~wrong).sum() + 20


def test_a_ball_around_cameras_holds_what_they_look_at():
    cameras = stack_cameras([scenes.orbit_camera(angle) for angle in (0, 60, 120)])
    ball = Ball.around(cameras)
    assert ball.center[0].norm() < 1e-4
    assert float(ball.radius[0]) == pytest.approx(DISTANCE / 2, rel=1e-4)
