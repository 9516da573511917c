import torch
from traced_scenes import SCENES, orbit_camera, render

from extrap_train.depth.stereo import agreement, forward_backward_error

ONE, OTHER = (render(SCENES["slanted plane"], orbit_camera(a, 96)) for a in (0, 12))


def test_exact_depths_of_a_plane_agree():
    error = forward_backward_error(1 / ONE.depth, ONE.camera, 1 / OTHER.depth, OTHER.camera)
    seen = error.isfinite()
    assert seen.float().mean() > 0.5
    assert error[seen].quantile(0.95) < 0.05


def test_a_wrong_depth_is_a_contradiction():
    error = forward_backward_error(1 / ONE.depth, ONE.camera, 1.3 / OTHER.depth, OTHER.camera)
    assert error[error.isfinite()].min() > 2
    assert not agreement(error[None]).any()


def test_half_of_the_neighbours_must_agree():
    right, wrong = torch.zeros(1, 1), torch.full((1, 1), 9.0)
    assert agreement(torch.stack([right, wrong])) == 1
    assert agreement(torch.stack([right, wrong, wrong, wrong])) == 0.5
    assert agreement(torch.stack([wrong, wrong])) == 0
