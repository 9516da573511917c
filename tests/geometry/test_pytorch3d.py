import pytest
import roma
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from extrap_train.geometry.cameras import project
from extrap_train.geometry.foreign_cameras import (
    NDC_FORMATS,
    Viewpoint,
    camera_from_viewpoint,
    viewpoint_from_camera,
)


def viewpoint(intrinsics_format, rotation=None, translation=(0, 0, 0), principal=(0, 0)):
    return Viewpoint(
        rotation=torch.eye(3).double() if rotation is None else torch.tensor(rotation).double(),
        translation=torch.tensor(translation).double(),
        focal_length=torch.tensor([2.0, 2.0]).double(),
        principal_point=torch.tensor(principal).double(),
        intrinsics_format=intrinsics_format,
    )


@pytest.mark.parametrize(
    ("intrinsics_format", "principal", "expected"),
    [
        # Half the shorter side, 50 px, is one unit: f = 100 px; a quarter left and up is 25 px.
        ("ndc_isotropic", (0.0, 0.0), (75.0, 25.0)),
        # Half of each side is one unit: f = 200 px across, 100 px down.
        ("ndc_norm_image_bounds", (0.0, 0.0), (50.0, 25.0)),
        # The principal point moves 0.1 units left and 0.2 down.
        ("ndc_isotropic", (0.1, -0.2), (70.0, 35.0)),
        ("ndc_norm_image_bounds", (0.1, -0.2), (40.0, 35.0)),
    ],
)
def test_a_point_to_the_left_and_above(intrinsics_format, principal, expected):
    camera = camera_from_viewpoint(viewpoint(intrinsics_format, principal=principal), 100, 200)
    pixel, depth = project(torch.tensor([[1.0, 1.0, 4.0]]).double(), camera)
    assert pixel[0].tolist() == pytest.approx(expected)
    assert depth.item() == 4


def test_points_are_rows():
    quarter_turn = [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]
    camera = camera_from_viewpoint(viewpoint("ndc_isotropic", quarter_turn, (0, 0, 5)), 100, 200)
    # (1 0 0) @ R + T = (0 1 5) with +Y up, which is (0 −1 5) with +Y down.
    in_camera = camera.world_to_cam @ torch.tensor([1.0, 0, 0, 1]).double()
    assert in_camera.tolist() == [0, -1, 5, 1]


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    intrinsics_format=st.sampled_from(NDC_FORMATS),
    height=st.integers(1, 3000),
    width=st.integers(1, 3000),
)
def test_there_and_back_and_the_projection_of_pytorch3d(seed, intrinsics_format, height, width):
    torch.manual_seed(seed)
    given_viewpoint = Viewpoint(
        roma.random_rotmat(2).double(),
        torch.randn(2, 3).double(),
        torch.rand(2, 2).double() * 3 + 0.5,
        torch.randn(2, 2).double() * 0.1,
        intrinsics_format,
    )
    camera = camera_from_viewpoint(given_viewpoint, height, width)
    again = viewpoint_from_camera(camera, intrinsics_format)
    for name in ("rotation", "translation", "focal_length", "principal_point"):
        torch.testing.assert_close(
            getattr(again, name), getattr(given_viewpoint, name), rtol=1e-11, atol=1e-11
        )

    points = torch.randn(2, 5, 3).double()
    cam = points @ given_viewpoint.rotation + given_viewpoint.translation[:, None]
    ndc = given_viewpoint.focal_length[:, None] * cam[..., :2] / cam[..., 2:]
    ndc = ndc + given_viewpoint.principal_point[:, None]
    size = torch.tensor([width, height]).double()
    unit = size / 2 if intrinsics_format == "ndc_norm_image_bounds" else size.min() / 2
    torch.testing.assert_close(project(points, camera)[0], size / 2 - ndc * unit)
