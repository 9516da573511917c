"""COLMAP models with quaternions in another order are refused by their points, right ones never.

The models are written with SciPy's rotations and projected here: nothing is the product's.
"""

import logging
import struct

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from extrap_train.data.scene_spec import open_scene
from extrap_train.errors import InputError

WIDTH, HEIGHT, FOCAL = 64, 48, 60.0
RNG = np.random.default_rng(0)
CLOUD = RNG.uniform(-0.5, 0.5, (200, 3))
AHEAD = np.array([0.3, 4, -1])


def looking(place, target):
    forward = (target - place) / np.linalg.norm(target - place)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return rotation, -rotation @ place


def circle(count=8):
    """Cameras around the origin: any rotation of theirs still looks at it."""
    angles = np.arange(count) / count * 2 * np.pi
    places = np.stack([2 * np.cos(angles), 2 * np.sin(angles), np.full(count, 0.8)], 1)
    return [looking(place, np.zeros(3)) for place in places]


def row(count=5):
    """Cameras side by side, which look the same way."""
    places = np.stack([np.linspace(-1, 1, count), np.zeros(count), np.zeros(count)], 1)
    return [looking(place, place + AHEAD) for place in places]


def pixels(rotation, translation, points):
    seen = points @ rotation.T + translation
    return seen[:, :2] / seen[:, 2:] * FOCAL + [WIDTH / 2, HEIGHT / 2]


MISTAKES = {
    "camera-to-world": lambda rotation, translation: (rotation.T, -rotation.T @ translation),
    "with R transposed": lambda rotation, translation: (rotation.T, translation),
    "the cameras' positions": lambda rotation, translation: (rotation, -rotation.T @ translation),
    "OpenGL's axes": lambda rotation, translation: (FLIP @ rotation, FLIP @ translation),
}
FLIP = np.diag([1.0, -1.0, -1.0])


def right(rotation, translation):
    return rotation, translation


def write(
    folder,
    cameras,
    points,
    kind="txt",
    order="wxyz",
    tracks=True,
    noise=0.3,
    outliers=0.2,
    written=right,
):
    (folder / "images").mkdir()
    rng = np.random.default_rng(1)
    images = []
    for index, (rotation, translation) in enumerate(cameras):
        Image.new("RGB", (WIDTH, HEIGHT)).save(folder / "images" / f"{index}.png")
        stored, beside = written(rotation, translation)
        x, y, z, w = Rotation.from_matrix(stored).as_quat()
        quaternion = (w, x, y, z) if order == "wxyz" else (x, y, z, w)
        seen = pixels(rotation, translation, points) + rng.normal(0, noise, (len(points), 2))
        wrong = rng.random(len(points)) < outliers
        seen[wrong] = rng.uniform(0, [WIDTH, HEIGHT], (wrong.sum(), 2))
        observed = [(*seen[i], i + 1 if i % 3 else -1) for i in range(len(points) * tracks)]
        images.append((index + 1, (*quaternion, *beside), f"{index}.png", observed))
    (write_text if kind == "txt" else write_binary)(folder, images, points)
    return str(folder)


def words(*values):
    return " ".join(map(str, values))


def write_text(folder, images, points):
    lens = words(FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)
    (folder / "cameras.txt").write_text(f"1 PINHOLE {WIDTH} {HEIGHT} {lens}\n")
    lines = []
    for number, pose, name, observed in images:
        lines += [words(number, *pose, 1, name), words(*np.array(observed, object).ravel())]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    lines = [words(i + 1, *point, 9, 9, 9, 0.5, 1, 0) for i, point in enumerate(points)]
    (folder / "points3D.txt").write_text("# points\n" + "\n".join(lines) + "\n")


def write_binary(folder, images, points):
    lens = struct.pack("<4d", FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)
    (folder / "cameras.bin").write_bytes(struct.pack("<QiiQQ", 1, 1, 1, WIDTH, HEIGHT) + lens)
    content = struct.pack("<Q", len(images))
    for number, pose, name, observed in images:
        content += struct.pack("<i7di", number, *pose, 1) + name.encode() + b"\0"
        content += struct.pack("<Q", len(observed))
        content += b"".join(struct.pack("<ddq", *one) for one in observed)
    (folder / "images.bin").write_bytes(content)
    content = struct.pack("<Q", len(points))
    for i, point in enumerate(points):
        content += struct.pack("<Q3d3BdQ", i + 1, *point, 9, 9, 9, 0.5, 2) + bytes(16)
    (folder / "points3D.bin").write_bytes(content)


@pytest.mark.parametrize("kind", ["txt", "bin"])
def test_quaternions_in_another_order_are_named_by_the_tracks(tmp_path, kind):
    spec = write(tmp_path, circle(), CLOUD, kind, order="xyzw")
    with pytest.raises(InputError, match="quaternions in the order x, y, z, w") as caught:
        open_scene(spec)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("cameras", [circle, row])
@pytest.mark.parametrize("name", MISTAKES)
def test_poses_in_another_convention_are_named(tmp_path, name, cameras):
    points = CLOUD if cameras is circle else CLOUD + AHEAD
    spec = write(tmp_path, cameras(), points, written=MISTAKES[name])
    with pytest.raises(InputError, match=name):
        open_scene(spec)


def test_quaternions_in_another_order_are_named_by_points_out_of_sight(tmp_path):
    ahead = CLOUD + AHEAD
    spec = write(tmp_path, row(), ahead, order="xyzw", tracks=False)
    with pytest.raises(InputError, match="quaternions in the order x, y, z, w"):
        open_scene(spec)


@pytest.mark.parametrize("kind", ["txt", "bin"])
@pytest.mark.parametrize("cameras", [circle, row])
@pytest.mark.parametrize(
    "options",
    [{}, {"tracks": False}, {"noise": 3.0, "outliers": 0.4}, {"noise": 40.0}, {"outliers": 1.0}],
)
def test_a_right_model_is_read_however_bad_its_tracks(tmp_path, caplog, kind, cameras, options):
    points = CLOUD if cameras is circle else CLOUD + AHEAD
    with caplog.at_level(logging.WARNING):
        found = open_scene(write(tmp_path, cameras(), points, kind, **options))
    assert len(found.frames) == len(cameras())
    assert not caplog.records


def test_right_cameras_in_a_room_whose_points_they_mostly_do_not_see_are_read(tmp_path):
    room = RNG.uniform(-5, 5, (400, 3)) * [8, 1, 1]
    spec = write(tmp_path, row(), room, tracks=False)
    assert len(open_scene(spec).frames) == 5


@pytest.mark.parametrize("order", ["wxyz", "xyzw"])
def test_nothing_is_said_without_points(tmp_path, order):
    spec = write(tmp_path, circle(), CLOUD, order=order)
    (tmp_path / "points3D.txt").unlink()
    assert len(open_scene(spec).frames) == 8


@pytest.mark.parametrize("kind", ["txt", "bin"])
def test_damaged_points_cost_the_check_alone(tmp_path, caplog, kind):
    spec = write(tmp_path, circle(), CLOUD, kind)
    file = tmp_path / f"points3D.{kind}"
    file.write_bytes(file.read_bytes()[:-30] + b"\n1 x")
    with caplog.at_level(logging.WARNING):
        assert len(open_scene(spec).frames) == 8
    assert f"points3D.{kind}" in caplog.text


def test_numbers_that_no_file_should_hold_are_passed_over(tmp_path):
    spec = write(tmp_path, circle(3), CLOUD)
    for name in ("images.txt", "points3D.txt"):
        text = (tmp_path / name).read_text()
        (tmp_path / name).write_text(text.replace(" 5\n", f" {10**40}\n").replace("\n7 ", "\n-7 "))
    with (tmp_path / "points3D.txt").open("a") as stream:
        stream.write(f"{10**40} 0 0 0\n8 nan inf 0\n")
    assert len(open_scene(spec).frames) == 3
