"""A scene's input views: which frames, and framed as training's are."""

import numpy as np
import pytest
import torch
from orbits import capture, even, ring

from extrap_train.data.scene_views import input_views, select_input_frames, target_views
from extrap_train.depth.dataset import DatasetDepth
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
