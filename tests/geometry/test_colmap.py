import pytest
import torch
from scipy.spatial.transform import Rotation

from extrap_train.geometry.foreign_cameras import (
    CAMERA_MODELS,
    PANORAMA,
    colmap_from_world_to_cam,
    lens_from_parameters,
    world_to_cam_from_colmap,
)


def test_a_quarter_turn_about_z():
    half = 0.5**0.5
    world_to_cam = world_to_cam_from_colmap(
        torch.tensor([half, 0, 0, half]), torch.tensor([1.0, 2, 3])
    )
    moved = world_to_cam @ torch.tensor([1.0, 0, 0, 1])
    torch.testing.assert_close(moved, torch.tensor([1.0, 3, 3, 1]))


def test_agrees_with_scipy_and_goes_there_and_back():
    rotations = Rotation.random(50, random_state=0)
    wxyz = torch.tensor(rotations.as_quat(canonical=True)[:, [3, 0, 1, 2]])
    translation = torch.randn(50, 3, generator=torch.Generator().manual_seed(0)).double()
    # Quaternions in a file need not have unit length.
    world_to_cam = world_to_cam_from_colmap(3 * wxyz, translation)
    torch.testing.assert_close(world_to_cam[:, :3, :3], torch.tensor(rotations.as_matrix()))
    quaternion_again, translation_again = colmap_from_world_to_cam(world_to_cam)
    torch.testing.assert_close(quaternion_again, wxyz)
    torch.testing.assert_close(translation_again, translation)


def test_no_rotation_is_made_up_for_a_zero_quaternion():
    assert world_to_cam_from_colmap(torch.zeros(4), torch.zeros(3)).isnan().any()


LENSES = [model for model in CAMERA_MODELS if model.name != PANORAMA]


@pytest.mark.parametrize("model", LENSES, ids=lambda model: model.name)
def test_every_camera_model_becomes_a_lens(model):
    values = {name: float(index + 1) for index, name in enumerate(model.parameters)}
    lens = lens_from_parameters(values, model.fisheye)
    assert lens.fisheye == model.fisheye
    assert (lens.cx, lens.cy) == (values["cx"], values["cy"])
    assert lens.fx == values.get("f", values.get("fx"))
    assert lens.fy == values.get("f", values.get("fy"))
    k1_first = values.get("k1", 0.0)
    assert lens.distortion[0] == k1_first
    assert lens.is_pinhole == (k1_first == 0 and not model.fisheye)
