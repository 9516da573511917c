"""The plane of symmetry is the object's own; where it has none, or shows none, there is none."""

from dataclasses import replace
from functools import partial

import pytest
import scenes
import torch
from rich.console import Console

from extrap_train.data.sequences import Frame
from extrap_train.geometry.cameras import unproject_to_world
from extrap_train.reconstruction.completion import map_of_inputs, with_masks
from extrap_train.reconstruction.global_map import Sight, look_up
from extrap_train.reconstruction.symmetry import MIRRORED, find_symmetries, mirrored_photographs
from extrap_train.tasks.mirrored_inputs import mirror_inputs
from extrap_train.views import View

SIZE = 64
GROUND = scenes.plane(0.6, (0.0, 1.0, 0.0))
# Symmetric in z = .05 alone: the ball stands at one end.
DUMBBELL = (
    scenes.box((-0.6, -0.1, -0.25), (0.5, 0.6, 0.35)),
    scenes.sphere(0.25, (-0.3, -0.3, 0.05)),
)
HEAP = (
    scenes.sphere(0.3, (0.0, 0.3, 0.0)),
    scenes.sphere(0.2, (0.5, 0.4, -0.2)),
    scenes.sphere(0.25, (-0.4, 0.1, -0.3)),
    scenes.sphere(0.15, (0.1, -0.3, -0.3)),
)


def photographed(shapes, *azimuths_deg):
    """The inputs' map, with the object's masks."""
    whole, alone = scenes.Scene((*shapes, GROUND)), scenes.Scene(shapes)
    views, masks = [], []
    for azimuth_deg in azimuths_deg:
        camera = scenes.orbit_camera(azimuth_deg, size=SIZE, elevation_deg=20.0)
        depth = whole.depth(camera)
        views.append(View(whole.image(camera), camera, depth, name=f"at{azimuth_deg}"))
        masks.append((alone.depth(camera) == depth) & (depth > 0))
    known = map_of_inputs(views, [(view.depth > 0).float() for view in views], 0.01)
    return with_masks(known, [mask.float() for mask in masks])


@pytest.fixture(scope="module")
def dumbbell():
    return photographed(DUMBBELL, 35.0, 55.0, 75.0)


def test_the_plane_of_an_object_with_one_is_found(dumbbell):
    (found,) = find_symmetries(dumbbell)
    normal = found.plane.normal * found.plane.normal[2].sign()
    # What is added is weighed against what agrees, within 2 % of the camera's distance.
    assert torch.rad2deg(torch.arccos(normal[2].clamp(max=1))) < 6
    at_middle = found.plane.offset * found.plane.normal[2].sign() / normal[2]
    assert abs(float(at_middle) - 0.05) < 0.03
    assert found.contradiction < 0.03 < found.gain


def test_mirrored_photographs_show_the_other_side_as_it_is(dumbbell):
    truth = scenes.Scene((*DUMBBELL, GROUND))
    for view in mirrored_photographs(dumbbell, find_symmetries(dumbbell)):
        shown = view.depth > 0
        assert shown.float().mean() > 0.01
        assert view.origin.kind == MIRRORED
        assert (view.confidence[shown] > 0).all()
        error = (view.depth / truth.depth(view.camera) - 1).abs()[shown]
        assert error.median() < 0.02
        assert (error < 0.04).float().mean() > 0.8


def test_what_a_photograph_shows_is_not_mirrored(dumbbell):
    for view in mirrored_photographs(dumbbell, find_symmetries(dumbbell)):
        points = unproject_to_world(view.depth, view.camera)[view.depth > 0]
        for own in dumbbell.views:
            sight = look_up(points, own.depth, own.camera, dumbbell.tolerance).sight
            assert not (sight == Sight.AGREES).any()


def test_a_heap_without_symmetry_has_none():
    assert find_symmetries(photographed(HEAP, 35.0, 55.0, 75.0)) == ()


def test_without_depth_beside_the_object_its_outline_still_speaks_against_planes():
    known = photographed(HEAP, 35.0, 55.0, 75.0)
    views = []
    for view in known.views:
        shown = view.view.mask > 0.5
        depth, confidence = (torch.where(shown, x, 0) for x in (view.depth, view.confidence))
        views.append(replace(view, view=replace(view.view, depth=depth), confidence=confidence))
    assert find_symmetries(replace(known, views=tuple(views))) == ()


@pytest.mark.parametrize("mask", [None, torch.ones(SIZE, SIZE)], ids=["none", "whole picture"])
def test_without_the_objects_outline_no_symmetry_is_sought(mask):
    """The flat ground is symmetric in every upright plane."""
    known = photographed(HEAP, 35.0, 55.0, 75.0)

    def masked(view, depth):
        return replace(view.view, mask=mask)

    frames = [
        Frame(view.view.name, view.camera, False, True, partial(masked, view), ())
        for view in known.views
    ]
    assert mirror_inputs(known, frames, Console(quiet=True)) == ((), ())


def test_without_an_object_there_is_none(dumbbell):
    nothing = [torch.zeros_like(view.depth) for view in dumbbell.views]
    assert find_symmetries(with_masks(dumbbell, nothing)) == ()
    assert find_symmetries(with_masks(dumbbell, [None] * len(dumbbell))) == ()


def test_an_object_with_two_planes_is_seen_in_both_and_in_one_after_the_other():
    known = photographed([scenes.box((-0.6, 0.0, -0.3), (0.6, 0.6, 0.3))], 35.0, 55.0, 75.0)
    found = find_symmetries(known)
    assert len(found) == 2
    first, second = (x.plane.normal for x in found)
    assert abs(float(first @ second)) < 0.2
    mirrored = mirrored_photographs(known, found)
    assert len(mirrored) == 3 * len(known)
    opposite = mirrored[-1]
    own = known.views[-1].camera
    assert float(opposite.camera.cam_to_world[:3, 2] @ own.cam_to_world[:3, 2]) < -0.6
