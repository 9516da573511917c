import cv2
import numpy as np
import pytest

from extrap_train.geometry.lens import Lens, distort, undistort

HEIGHT, WIDTH = 180, 240

LENSES = {
    "barrel": Lens(200.0, 205.0, 118.3, 92.1, (-0.2, 0.05, 0.001, -0.002)),
    "pincushion": Lens(200.0, 205.0, 118.3, 92.1, (0.25, -0.02, 0.0, 0.0, 0.01)),
    "fisheye": Lens(150.0, 150.0, 121.0, 88.0, (-0.03, 0.01, 0.0, 0.0), fisheye=True),
}


def pattern(directions):
    return 0.5 + 0.25 * np.sin(40 * directions[..., 0]) + 0.25 * np.cos(30 * directions[..., 1])


def pixel_centres():
    return np.stack(np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5), -1)


def directions_seen_by(lens):
    """The lens inverted by OpenCV's iteration, which has no pixel-centre convention of its own."""
    pixels = pixel_centres().reshape(-1, 1, 2)
    coefficients = np.array(lens.distortion)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)
    if lens.fisheye:
        seen = cv2.fisheye.undistortPoints(pixels, lens.matrix, coefficients, criteria=criteria)
    else:
        seen = cv2.undistortPoints(pixels, lens.matrix, coefficients, criteria=criteria)
    return seen.reshape(HEIGHT, WIDTH, 2)


@pytest.mark.parametrize("name", LENSES)
def test_the_undistorted_picture_is_what_a_pinhole_sees(name):
    lens = LENSES[name]
    pinhole = lens.pinhole(HEIGHT, WIDTH)
    seen = pattern(directions_seen_by(lens)).astype(np.float32)
    centre, focal = [pinhole.cx, pinhole.cy], [pinhole.fx, pinhole.fy]
    expected = pattern((pixel_centres() - centre) / focal)
    error = np.abs(undistort(seen, lens, pinhole) - expected)
    # Bilinear interpolation costs 0.003; half a pixel of a wrong centre, more than 0.01.
    assert error.mean() < 0.004
    assert error.max() < 0.05


@pytest.mark.parametrize("name", LENSES)
def test_no_pixel_of_the_undistorted_picture_is_empty(name):
    lens = LENSES[name]
    pinhole = lens.pinhole(HEIGHT, WIDTH)
    directions = (pixel_centres() - [pinhole.cx, pinhole.cy]) / [pinhole.fx, pinhole.fy]
    pixels = distort(directions.reshape(-1, 2), lens)
    assert (pixels >= 0).all()
    assert (pixels <= [WIDTH, HEIGHT]).all()


def test_nearest_resampling_invents_no_depth():
    steps = np.where(np.arange(WIDTH) < 100, 1.0, 9.0).astype(np.float32) * np.ones((HEIGHT, 1))
    lens = LENSES["pincushion"]
    straight = undistort(steps.astype(np.float32), lens, lens.pinhole(HEIGHT, WIDTH), nearest=True)
    assert set(np.unique(straight)) == {1.0, 9.0}


def test_a_straight_lens_stays_as_it_is():
    lens = Lens(200.0, 205.0, 118.3, 92.1, (0.0, 0.0, 0.0, 0.0))
    assert lens.is_pinhole
    pinhole = lens.pinhole(HEIGHT, WIDTH)
    assert (pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy) == (200, 205, 118.3, 92.1)


def test_a_lens_that_nothing_is_left_of_is_refused():
    with pytest.raises(ValueError, match="cannot be undone"):
        Lens(50.0, 50.0, 120.0, 90.0, (90.0, 0.0, 0.0, 0.0)).pinhole(HEIGHT, WIDTH)


def test_a_picture_ends_before_the_lens_folds():
    """r(1 − 0.35 r²) turns back at r = 0.976; the corners of the unzoomed picture are at 1.05."""
    lens = Lens(300.0, 300.0, 250.0, 190.0, (-0.35, 0.0, 0.0, 0.0))
    pinhole = lens.pinhole(380, 500)
    corner = np.hypot(250 / pinhole.fx, 190 / pinhole.fy)
    assert corner < 1 / np.sqrt(3 * 0.35) + 1e-3
    assert corner > 0.95


def test_a_lens_that_folds_close_to_its_middle_cannot_be_undone():
    lens = Lens(300.0, 300.0, 250.0, 190.0, (-40.0, 0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="cannot be undone"):
        lens.pinhole(380, 500)
