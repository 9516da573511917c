"""What a model is adapted to a scene with: nothing that it is measured on, and no reference that
sees what no input sees.
"""

import numpy as np
import pytest
import torch
from orbits import walls
from scenes import SPHERE_ON_PLANE, orbit_camera

from extrap_train.data.scene_pairs import (
    ScenePairs,
    VirtualPairs,
    adaptation_pairs,
    virtual_references,
)
from extrap_train.errors import InputError
from extrap_train.geometry.viewpoints import pairwise_angles, scene_center
from extrap_train.views import View, stack_cameras


def _around(azimuths_deg: list[float], size: int = 64) -> list[View]:
    """A sphere before a wall, with exact depth."""
    cameras = [orbit_camera(azimuth, size=size) for azimuth in azimuths_deg]
    scene = SPHERE_ON_PLANE
    return [View(scene.image(c), c, scene.depth(c), name=f"at {c.center}") for c in cameras]


def test_the_pairs_are_all_ordered_ones_and_the_held_out_query_is_never_a_target() -> None:
    pairs = ScenePairs(walls(4), 3)
    assert len(set(pairs.all)) == len(pairs.all) == 12
    ((query, reference),) = pairs.held_out
    assert abs(query - reference) in (2, 3), "50 or 75 degrees, nearest to 60"
    assert all(other != query for other, _ in pairs.training)
    assert pairs.counts() == {"all": 12, "trained": 9}
    batch = pairs.held_out_batch()
    assert len(batch.image) == 1
    torch.testing.assert_close(batch.image[0], walls(4)[query].image)
    torch.testing.assert_close(batch.reference_images[0, 0], walls(4)[reference].image)


@pytest.mark.parametrize("virtual", [0, 4])
def test_one_view_has_no_pairs(virtual: int) -> None:
    with pytest.raises(InputError, match="1 input view, and pairs need at least two"):
        adaptation_pairs(walls(1), 3, virtual, seed=0)


def test_virtual_references_show_what_a_camera_would_see_from_there() -> None:
    """Against the analytic scene: colours and depths where the query reaches, nothing elsewhere."""
    views = _around([0.0, 40.0, 80.0])
    made = virtual_references(views, 4, seed=0)
    assert [reference.query for reference in made] == [0] * 4 + [1] * 4 + [2] * 4
    for reference in made:
        camera, depth = reference.view.camera, reference.view.depth
        assert depth is not None
        known = depth > 0
        assert known.float().mean() > 0.25
        exact = SPHERE_ON_PLANE.depth(camera)
        assert ((depth - exact).abs() < 0.03 * exact)[known].float().mean() > 0.95
        wrong = (reference.view.image - SPHERE_ON_PLANE.image(camera)).abs().mean(0)[known]
        assert wrong.median() < 0.02
        assert reference.view.image.isfinite().all(), "holes are filled"


def test_they_stand_beside_their_query_by_the_angle_that_is_said() -> None:
    views = _around([0.0, 40.0, 80.0])
    made = virtual_references(views, 6, seed=1)
    center = scene_center(stack_cameras([view.camera for view in views]))
    angles = np.rad2deg([reference.angle_rad for reference in made]).reshape(3, 6)
    assert (angles >= 10).all()
    assert (angles <= 60).all()
    assert (np.diff(angles) > 0).all(), "one in every part of the range"
    for reference in made:
        both = stack_cameras([views[reference.query].camera, reference.view.camera])
        seen = pairwise_angles(both, center)[0, 1]
        level = np.cos(np.deg2rad(10))  # of elevation: the chord of a turn is shorter up there
        assert np.sin(seen / 2) == pytest.approx(level * np.sin(reference.angle_rad / 2), abs=0.02)


def test_views_that_look_past_each_other_turn_about_what_they_see_themselves() -> None:
    camera = orbit_camera(0.0, size=64)
    beside = camera.world_to_cam.clone()
    beside[0, 3] -= 2.0
    scene = SPHERE_ON_PLANE
    cameras = [camera, type(camera)(beside, camera.intrinsics, 64, 64)]
    views = [View(scene.image(c), c, scene.depth(c)) for c in cameras]
    for reference in virtual_references(views, 2, seed=0):
        view = views[reference.query]
        assert view.depth is not None
        pivot = view.camera.center + view.depth.median() * view.camera.forward
        there = reference.view.camera
        pixel = there.intrinsics @ (there.world_to_cam[:3, :3] @ pivot + there.world_to_cam[:3, 3])
        torch.testing.assert_close(pixel[:2] / pixel[2], torch.tensor([32.0, 32.0]))


def test_virtual_pairs_generate_every_photograph_but_from_no_reference_that_is_held_out() -> None:
    views = _around([0.0, 40.0, 60.0, 100.0])
    pairs = VirtualPairs(views, 3, 4, seed=0)
    assert pairs.counts() == {"all": 16, "trained": 12}
    held_out = pairs.held_out_batch()
    for image, view in zip(held_out.image, views, strict=True):
        assert torch.equal(image, view.image)
    batch = pairs.training_batch(24, np.random.default_rng(0))
    seen = [sum(torch.equal(image, view.image) for image in batch.image) for view in views]
    assert seen == [6, 6, 6, 6], "every pair twice"
    for first in batch.reference_images[:, 0]:
        assert not any(torch.equal(first, other) for other in held_out.reference_images[:, 0])
    assert 0 < batch.reference_valid.sum() - 24 < 48, "with and without inputs behind them"


def test_pairs_are_a_function_of_the_seed() -> None:
    views = _around([0.0, 120.0, 240.0])
    one, same, other = (VirtualPairs(views, 3, 2, seed) for seed in (0, 0, 1))
    first = one.held_out_batch().reference_images
    assert torch.equal(first, same.held_out_batch().reference_images)
    assert not torch.equal(first, other.held_out_batch().reference_images)
