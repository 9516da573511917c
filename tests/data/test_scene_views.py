"""A scene's input views: which frames, and framed as training's are."""

import numpy as np
import pytest
import torch
from orbits import capture, even, ring

from extrap_train.data.square_frames import (
    input_views,
    select_input_frames,
    target_views,
)
from extrap_train.depth import DatasetDepth
from extrap_train.errors import InputError

SCENE = capture(ring(even(12)))


def test_inputs_are_spread_named_or_all():
    assert select_input_frames(SCENE, (), 3) in ([0, 3, 6], [0, 6, 9]), (
        "a half and a quarter turn away"
    )
    assert select_input_frames(SCENE, (), None) == list(range(12))
    assert select_input_frames(SCENE, ("frame7", "frame2"), 3) == [2, 7]


def test_more_inputs_than_frames_and_unknown_names_are_refused():
    with pytest.raises(InputError, match="has 12 frames, fewer than the 13 asked for"):
        select_input_frames(SCENE, (), 13)
    with pytest.raises(InputError, match=r"has no frame fram7; did you mean frame7"):
        select_input_frames(SCENE, ("fram7",), None)


def test_views_have_the_models_size_and_their_own_depth():
    views = input_views(SCENE, [3, 8], DatasetDepth(), 16)
    assert [view.name for view in views] == ["frame3", "frame8"]
    assert views[0].image.shape == (3, 16, 16)
    assert (views[0].depth == 3).all()
    torch.testing.assert_close(views[1].image, torch.full((3, 16, 16), 8 / 12), atol=3e-3, rtol=0)
    truth = target_views([SCENE.frames[3]], 16)[0]
    np.testing.assert_allclose(truth.camera.intrinsics, views[0].camera.intrinsics, atol=1e-4)
    assert truth.depth is None


@pytest.mark.parametrize("count", [3, 5, 9])
def test_one_bad_frame_costs_its_frame_while_two_are_left(count, caplog):
    scene = capture(ring(even(12)), broken=(1,))
    views = input_views(scene, list(range(count)), DatasetDepth(), 16)
    assert [view.name for view in views] == [f"frame{i}" for i in range(count) if i != 1]
    assert "frame1.jpg: truncated" in caplog.text


@pytest.mark.parametrize(("count", "broken"), [(2, (1,)), (3, (0, 1)), (9, (1, 2))])
def test_more_bad_frames_are_too_many(count, broken):
    with pytest.raises(InputError, match="frames cannot be used"):
        input_views(capture(ring(even(12)), broken=broken), list(range(count)), DatasetDepth(), 16)


def test_a_bad_held_out_photograph_is_left_out(caplog):
    frames = capture(ring(even(4)), broken=(2,)).frames
    assert [view.name for view in target_views(frames, 16)] == ["frame0", "frame1", "frame3"]
    assert target_views(frames[2:3], 16) == []
    assert "frame2.jpg: truncated" in caplog.text
