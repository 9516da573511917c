"""Each key of a transforms.json that changes the lens is understood or refused by its name."""

import math

import numpy as np
import pytest

from extrap_train.data.lens_keys import REFUSED, lens_of, merge_entry
from extrap_train.geometry.cuts import Equirectangular
from extrap_train.geometry.lens import Lens, distort

HEIGHT, WIDTH = 96, 128
PINHOLE = {"fl_x": 80, "fl_y": 81, "cx": 60, "cy": 50}
WHOLE = {"fl_x": WIDTH / 2, "fl_y": HEIGHT, "cx": WIDTH / 2, "cy": HEIGHT / 2}
RADIAL = {"k1": -0.2, "k2": 0.12, "k3": -0.1, "k4": 0.2}


def lens(**keys) -> Lens:
    return lens_of(keys, HEIGHT, WIDTH)


def test_a_pinhole_is_what_it_says():
    assert lens(**PINHOLE) == Lens(80.0, 81.0, 60.0, 50.0, (0.0,) * 8)


@pytest.mark.parametrize(
    ("keys", "focal"),
    [
        ({"fl_x": 80}, (80, 80)),
        ({"fl_y": 80}, (80, 80)),
        ({"fl_x": 80, "fl_y": 90}, (80, 90)),
        ({"camera_angle_x": 2 * math.atan(64 / 115)}, (115, 115)),
        ({"camera_angle_x": 2 * math.atan(0.5), "camera_angle_y": 2 * math.atan(0.6)}, (128, 80)),
        ({"camera_angle_y": 2 * math.atan(48 / 90)}, (90, 90)),
        ({"fl_x": 80, "camera_angle_y": 2 * math.atan(48 / 90)}, (80, 90)),
        ({"x_fov": 90.0}, (64, 64)),
        ({"x_fov": 90.0, "y_fov": 60.0}, (64, 48 / math.tan(math.pi / 6))),
    ],
)  # fmt: skip
def test_every_spelling_of_the_focal_length(keys, focal):
    read = lens(**keys)
    assert (read.fx, read.fy) == pytest.approx(focal)
    assert (read.cx, read.cy) == (64, 48)


def test_a_fourth_radial_term_of_a_perspective_camera_is_of_the_numerator():
    read = lens(**PINHOLE, **RADIAL, p1=0.001, p2=-0.002)
    x, y = 0.4, -0.3
    r2 = x * x + y * y
    radial = 1 - 0.2 * r2 + 0.12 * r2**2 - 0.1 * r2**3 + 0.2 * r2**4
    u = x * radial + 2 * 0.001 * x * y - 0.002 * (r2 + 2 * x * x)
    v = y * radial + 0.001 * (r2 + 2 * y * y) - 2 * 0.002 * x * y
    expected = [80 * u + 60, 81 * v + 50]
    np.testing.assert_allclose(distort(np.array([[x, y]]), read)[0], expected, atol=1e-9)


def test_without_a_fourth_term_the_lens_is_opencvs():
    without = {key: value for key, value in RADIAL.items() if key != "k4"}
    points = np.array([[0.4, -0.3], [0.1, 0.5]])
    both = [distort(points, lens(**PINHOLE, **without, **more)) for more in ({}, {"k4": 1e-13})]
    np.testing.assert_allclose(*both, atol=1e-8)


def test_the_rational_model_is_said_by_its_name():
    keys = {**PINHOLE, "k4": 0.1, "k5": 0.2, "k6": 0.3}
    assert lens(**keys, camera_model="FULL_OPENCV").distortion == (0, 0, 0, 0, 0, 0.1, 0.2, 0.3)


@pytest.mark.parametrize(
    "said", [{"is_fisheye": True}, {"camera_model": "OPENCV_FISHEYE"}, {"camera_model": "FISHEYE"}]
)
def test_a_fisheye_lens_by_each_name(said):
    read = lens(**PINHOLE, **RADIAL, p1=0, p2=0.0, **said)
    assert read.fisheye
    assert read.distortion == tuple(RADIAL.values())
    assert read.radial_r8 == 0


def test_a_list_of_coefficients_has_nerfstudios_order():
    listed = lens(**PINHOLE, distortion_params=[-0.2, 0.12, -0.1, 0.2, 0.001, 0.002])
    assert listed == lens(**PINHOLE, **RADIAL, p1=0.001, p2=0.002)
    both = {"distortion_params": [*RADIAL.values(), 0, 0], "p1": 0, "p2": 0}
    assert lens(**PINHOLE, **both) == lens(**PINHOLE, **RADIAL)


def test_four_coefficients_are_those_of_a_fisheye_or_have_no_more_than_two_terms():
    fisheye = lens(**PINHOLE, is_fisheye=True, distortion_params=list(RADIAL.values()))
    assert fisheye == lens(**PINHOLE, is_fisheye=True, **RADIAL)
    assert lens(**PINHOLE, distortion_params=[0.1, 0.2, 0, 0]) == lens(**PINHOLE, k1=0.1, k2=0.2)


@pytest.mark.parametrize(
    ("keys", "named"),
    [
        ({"camera_model": "EQUIRECTANGULAR"}, "fl_x|fl_y|cx|cy"),
        *(
            ({"camera_model": "EQUIRECTANGULAR", **WHOLE, key: value}, key)
            for key, value in (("is_fisheye", True), ("x_fov", 90), ("camera_angle_x", 1.5))
        ),
        ({"camera_model": "EQUIRECTANGULAR", "fl_x": 64, "fl_y": 96, "cx": 64, "cy": 40}, "cy"),
        ({"camera_model": "FISHEYE624"}, "FISHEYE624"),
        ({"camera_model": ["OPENCV"]}, "camera_model"),
        ({"camera_model": "OPENCV", "is_fisheye": True}, "is_fisheye"),
        ({"camera_model": "OPENCV_FISHEYE", "is_fisheye": False}, "is_fisheye"),
        ({"is_fisheye": "false"}, "is_fisheye"),
        ({"is_fisheye": True, "p1": 0.01}, "p1"),
        ({"is_fisheye": True, "k5": 0.01}, "k5"),
        ({"k5": 0.01}, "k5"),
        ({"k6": 0.01, "camera_model": "OPENCV"}, "k6"),
        ({"distortion_params": [0.1] * 12}, "distortion_params"),
        ({"distortion_params": [0.1] * 6, "k1": 0.2}, "distortion_params"),
        ({"distortion_params": "none"}, "distortion_params"),
        ({"distortion_params": [0.1, 0.01, 0.001, 0.002]}, "distortion_params"),
        ({"camera_model": "PINHOLE", "k1": -0.2}, "k1"),
        ({"camera_model": "SIMPLE_RADIAL", "k1": 0.1, "k2": 0.2}, "k2"),
        ({"camera_model": "RADIAL", "k1": 0.1, "p1": 0.01}, "p1"),
        ({"fl_x": True}, "fl_x"),
        ({"cx": None}, "cx"),
        ({"k1": []}, "k1"),
        *(({key: 1}, key) for key in REFUSED),
        ({"rolling_shutter": [0, 0, 1, 0]}, "rolling_shutter"),
    ],
)  # fmt: skip
def test_what_cannot_be_undone_is_named(keys, named):
    with pytest.raises(ValueError, match=named):
        lens(**(PINHOLE | keys))


def test_a_panorama_as_nerfstudio_writes_it():
    said = WHOLE | {"k1": 0}
    assert lens(camera_model="EQUIRECTANGULAR", **said) == Equirectangular()
    with pytest.raises(ValueError, match="k1"):
        lens(camera_model="EQUIRECTANGULAR", **(said | {"k1": 0.1}))


@pytest.mark.parametrize("angle", [{"camera_angle_x": 45}, {"x_fov": 200}, {"camera_angle_y": 0}])
def test_an_angle_in_the_wrong_unit_is_named(angle):
    with pytest.raises(ValueError, match=next(iter(angle))):
        lens(**angle)


@pytest.mark.parametrize("value", [0, 0.0, False, None, [], [0, 0, 0, 0]])
@pytest.mark.parametrize("key", REFUSED)
def test_keys_that_say_nothing_are_passed_over(key, value):
    assert lens(**PINHOLE, **{key: value}) == lens(**PINHOLE)


def test_keys_that_change_no_lens_are_passed_over():
    others = {"aabb_scale": 16, "sharpness": 3.0, "fisheye_crop_radius": 400, "timestamp": 1}
    assert lens(**PINHOLE, **others) == lens(**PINHOLE)


@pytest.mark.parametrize(
    ("common", "own", "focal"),
    [
        ({"fl_x": 50, "fl_y": 60}, {"fl_x": 80}, (80, 60)),
        ({"fl_x": 50}, {"x_fov": 90.0}, (64, 64)),
        ({"x_fov": 90.0}, {"fl_x": 50}, (50, 50)),
        ({"fl_x": 50, "fl_y": 60}, {"camera_angle_y": 2 * math.atan(48 / 90)}, (50, 90)),
    ],
)
def test_what_a_frame_says_itself_comes_first(common, own, focal):
    read = lens(**merge_entry(common, own))
    assert (read.fx, read.fy) == pytest.approx(focal)


def test_a_frames_own_spelling_of_the_distortion_replaces_the_other():
    own = {"distortion_params": [0.1, 0, 0, 0, 0, 0]}
    assert lens(**merge_entry(PINHOLE | RADIAL, own)).distortion[:3] == (0.1, 0, 0)
    merged = merge_entry(PINHOLE | {"distortion_params": [0.1] * 6}, {"k1": 0.3})
    assert lens(**merged).distortion == (0.3, *(0.0,) * 7)
    merged = merge_entry({**PINHOLE, "is_fisheye": True}, {"camera_model": "OPENCV"})
    assert not lens(**merged).fisheye
