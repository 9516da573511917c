"""In the tests, no tensor of the wrong shape gets through a public function unnoticed."""

import pytest
import torch
from jaxtyping import TypeCheckError
from scenes import orbit_camera

from extrap_train.diffusion.encoders import SmallImageEncoder
from extrap_train.geometry.cameras import project
from extrap_train.metrics import psnr
from extrap_train.views import Camera, View


def test_a_function_checks_each_argument() -> None:
    with pytest.raises(TypeCheckError):
        project(torch.zeros(5, 2), orbit_camera(0, size=8))


def test_a_function_checks_its_arguments_against_each_other() -> None:
    with pytest.raises(TypeCheckError):
        psnr(torch.zeros(1, 3, 8, 8), torch.zeros(1, 3, 8, 9))


def test_a_dataclass_checks_its_fields() -> None:
    camera = orbit_camera(0, size=8)
    with pytest.raises(TypeCheckError):
        Camera(camera.world_to_cam, camera.world_to_cam, 8, 8)
    with pytest.raises(TypeCheckError):
        View(torch.zeros(3, 8, 8), camera, depth=torch.ones(8, 9))


def test_a_method_checks_its_arguments() -> None:
    with pytest.raises(TypeCheckError):
        SmallImageEncoder(32)(torch.zeros(3, 8, 8))


def test_calls_that_have_passed_let_no_other_shape_pass() -> None:
    camera = orbit_camera(0, size=8)
    for _ in range(2):
        psnr(torch.zeros(1, 3, 8, 8), torch.zeros(1, 3, 8, 8))
        View(torch.zeros(3, 8, 8), camera)
    with pytest.raises(TypeCheckError):
        psnr(torch.zeros(1, 3, 8, 8), torch.zeros(1, 3, 9, 8))
    with pytest.raises(TypeCheckError):
        View(torch.zeros(4, 8, 8), camera)
