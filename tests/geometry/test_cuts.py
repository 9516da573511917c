"""Perspective views cut out of panoramas and wide fisheyes."""

import numpy as np
import pytest

from extrap_train.geometry.cuts import Cut, Equirectangular, cuts_of, project_fisheye
from extrap_train.geometry.lens import Lens, distort

PANORAMA = 200, 400
SIDE = 300
BENT = (-0.02, 0.003, -0.0005, 0.0)
WIDE = Lens(80.0, 80.0, 151.0, 148.0, BENT, fisheye=True)
"""Sees about 230 degrees."""


def pattern(directions):
    x, y, z = np.moveaxis(directions / np.linalg.norm(directions, axis=-1, keepdims=True), -1, 0)
    return (0.5 + 0.2 * np.sin(6 * x + 1) + 0.2 * np.cos(5 * y) * np.sin(4 * z)).astype(np.float32)


def pixel_centres(height, width):
    return np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1)


def panorama():
    """The pattern by longitude and latitude."""
    u, v = np.moveaxis(pixel_centres(*PANORAMA), -1, 0)
    longitude, up = (u / 400 - 0.5) * 2 * np.pi, (0.5 - v / 200) * np.pi
    directions = [np.cos(up) * np.sin(longitude), -np.sin(up), np.cos(up) * np.cos(longitude)]
    return pattern(np.stack(directions, -1))


def fisheye(lens):
    """The pattern by angle, which bisection finds from the distance to the middle."""
    pixels = (pixel_centres(SIDE, SIDE) - [lens.cx, lens.cy]) / [lens.fx, lens.fy]
    radius = np.linalg.norm(pixels, axis=-1)
    low, high = np.zeros_like(radius), np.full_like(radius, 2.2)
    for _ in range(40):
        middle = (low + high) / 2
        shown = middle + sum(k * middle ** (3 + 2 * i) for i, k in enumerate(lens.distortion))
        low, high = np.where(shown < radius, middle, low), np.where(shown < radius, high, middle)
    across = pixels * (np.sin(low) / radius)[..., None]
    return pattern(np.concatenate([across, np.cos(low)[..., None]], -1))


def shown_directions(cut):
    """Of the cut's pixels, in the picture's axes: a turn to the right about the vertical."""
    ahead = np.concatenate(
        [pixel_centres(cut.side, cut.side) / (cut.side / 2) - 1, np.ones((cut.side, cut.side, 1))],
        -1,
    )
    yaw = np.radians(cut.yaw_deg)
    x = ahead[..., 0] * np.cos(yaw) + ahead[..., 2] * np.sin(yaw)
    z = -ahead[..., 0] * np.sin(yaw) + ahead[..., 2] * np.cos(yaw)
    return np.stack([x, ahead[..., 1], z], -1)


@pytest.mark.parametrize(
    ("lens", "picture"),
    [(Equirectangular(), panorama()), (WIDE, fisheye(WIDE))],
    ids=["360", "200"],
)
def test_a_cut_shows_what_a_pinhole_sees(lens, picture):
    for cut in cuts_of(lens, *picture.shape):
        error = np.abs(cut.extract(picture) - pattern(shown_directions(cut)))
        assert error.max() < 0.01, cut.yaw_deg  # interpolation; half a pixel is worth 0.03


def test_all_directions_near_the_horizon_are_shown():
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(2000, 3))
    directions[:, 1] *= 0.3
    near = np.abs(directions[:, 1]) < 0.8 * np.hypot(directions[:, 0], directions[:, 2])
    seen = np.zeros(len(directions), int)
    for cut in cuts_of(Equirectangular(), *PANORAMA):
        x, y, z = (directions @ cut.cut_from_picture.T).T
        seen += (z > 0) & (np.abs(x) <= z) & (np.abs(y) <= z)
    assert (seen[near] >= 1).all()


def test_wide_fisheyes_are_cut_ahead_and_to_both_sides():
    equidistant = Lens(SIDE / np.radians(201), SIDE / np.radians(201), 150, 150, fisheye=True)
    yaws = [cut.yaw_deg for cut in cuts_of(equidistant, SIDE, SIDE)]
    assert yaws == [0, 55, 360 - 55]  # half of 201 degrees, less half of 90
    for lens in (Lens(80, 80, 150, 150), Lens(160.0, 160.0, 150.0, 150.0, BENT, fisheye=True)):
        assert cuts_of(lens, SIDE, SIDE) == ()


def test_a_cut_never_shows_what_is_beyond_a_fold():
    folding = Lens(80.0, 80.0, 150.0, 150.0, (-0.15, 0.0, 0.0, 0.0), fisheye=True)  # at 85 degrees
    assert cuts_of(folding, SIDE, SIDE) == ()


def test_the_fisheye_is_that_of_opencv():
    points = np.random.default_rng(1).normal(size=(50, 2))
    rays = np.concatenate([points, np.ones((50, 1))], 1)
    np.testing.assert_allclose(project_fisheye(rays, WIDE), distort(points, WIDE), atol=1e-6)


def test_pictures_are_projected_as_colmap_does():
    pycolmap = pytest.importorskip("pycolmap", reason="needs pycolmap: the extra `poses`")
    directions = np.random.default_rng(2).normal(size=(50, 3))
    height, width = PANORAMA
    camera = pycolmap.Camera(model="EQUIRECTANGULAR", width=width, height=height, params=[400, 200])
    expected = np.stack([camera.img_from_cam(direction) for direction in directions])
    np.testing.assert_allclose(
        Equirectangular().project(directions, height, width), expected, atol=1e-6
    )


def test_nearest_pixels_are_not_mixed():
    mask = (np.arange(400) // 37 % 2).astype(np.float32) * np.ones((200, 1), np.float32)
    cut = Cut(Equirectangular(), *PANORAMA, yaw_deg=180)
    assert set(np.unique(cut.extract(mask, nearest=True))) == {0, 1}
