"""The untrained rows do what their names say, and take the time that they say."""

import time

import torch

from benchmarks.methods.base import Method, Stopwatch
from benchmarks.methods.untrained import InpaintedWarp, NearestPhoto
from extrap_train.metrics import psnr
from tests.benchmarks.analytic import scene_inputs


def test_nearest_photo_is_the_nearest_by_angle() -> None:
    inputs, _ = scene_inputs((0.0, 40.0, 80.0), (10.0, 55.0, 90.0))
    made = NearestPhoto().synthesize(inputs)
    for image, index in zip(made.images, (0, 1, 2), strict=True):
        torch.testing.assert_close(image, inputs.views[index].image)


def test_an_input_seen_from_its_own_place_comes_back() -> None:
    inputs, _ = scene_inputs((0.0, 40.0), (0.0, 40.0), size=48)
    truth = torch.stack([view.resized(48, 48).image for view in inputs.fine_views])
    made = InpaintedWarp(references=1).synthesize(inputs)
    assert (psnr(made.images, truth) > 28).all()  # all but the inpainted rims of the ball


def test_the_warp_beats_the_nearest_photo() -> None:
    inputs, truth = scene_inputs(size=48)
    warped, nearest = InpaintedWarp().synthesize(inputs), NearestPhoto().synthesize(inputs)
    assert (psnr(warped.images, truth) > psnr(nearest.images, truth) + 3).all()


def test_both_are_methods_and_the_watch_adds_up() -> None:
    assert isinstance(NearestPhoto(), Method)
    assert isinstance(InpaintedWarp(), Method)
    watch = Stopwatch()
    for _ in range(2):
        with watch:
            time.sleep(0.02)
    assert 0.04 <= watch.seconds < 1
