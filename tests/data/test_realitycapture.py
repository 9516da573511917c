"""RealityCapture's table of internal and external camera parameters."""

import csv
import io

import numpy as np
import pytest
from complaints import complaint_of
from foreign_exports import POINTS, dot_of, pixels_of, save_dot, shots
from PIL import Image
from scipy.spatial.transform import Rotation

from extrap_train.data.scene_spec import open_scene

WIDTH, HEIGHT = 320, 240
SHOTS = shots(4, world_up=(0.0, 0.0, 1.0))
POSE = ["#name", "x", "y", "alt", "heading", "pitch", "roll"]
COLUMNS = [*POSE, "f", "px", "py", "k1", "k2", "k3", "k4", "t1", "t2"]
LENS = {"f": 45.0, "px": -0.02, "py": 0.015}
DISTORTION = {"k1": -0.2, "k2": 0.1, "k3": 0.05, "k4": -0.02, "t1": 0.02, "t2": -0.01}


def angles_deg(shot):
    """Heading, pitch and roll: a clockwise turn about up, then about the camera's +X and +Y."""
    yaw, pitch, roll = Rotation.from_matrix(shot.opengl_matrix[:3, :3]).as_euler(
        "ZXY", degrees=True
    )
    return {"heading": -yaw, "pitch": pitch, "roll": roll}


def rows(lens, offset=(0, 0, 0)):
    for index, shot in enumerate(SHOTS):
        position = dict(zip(("x", "y", "alt"), shot.position + offset, strict=True))
        yield {"#name": f"frame_{index}.png"} | position | angles_deg(shot) | lens


def pixel_of(point, shot, f, px, py, k1=0, k2=0, k3=0, k4=0, t1=0, t2=0):
    """As nerfstudio has it: lengths of 36 mm film, offsets in shares of the longer side."""
    x, y = shot.directions(point)
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3 + k4 * r2**4
    u = x * radial + 2 * t1 * x * y + t2 * (r2 + 2 * x * x)
    v = y * radial + t1 * (r2 + 2 * y * y) + 2 * t2 * x * y
    focal = f * WIDTH / 36
    return np.array([focal * u + px * WIDTH + WIDTH / 2, focal * v + py * WIDTH + HEIGHT / 2])


def write(folder, entries=None, lens=LENS, columns=COLUMNS, before=""):
    for index, (shot, point) in enumerate(zip(SHOTS, POINTS, strict=True)):
        path = folder / f"frame_{index}.png"
        save_dot(path, pixel_of(point, shot, **lens), WIDTH, HEIGHT)
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, restval=0, extrasaction="ignore")
    writer.writeheader()
    writer.writerows(rows(lens) if entries is None else entries)
    (folder / "cameras.csv").write_text(before + text.getvalue())
    return str(folder)


@pytest.mark.parametrize("lens", [LENS, LENS | DISTORTION], ids=len)
@pytest.mark.parametrize("before", ["", "#cameras 4\n", "\ufeff"])
def test_dots_are_where_the_camera_says(tmp_path, lens, before):
    frames = open_scene(write(tmp_path, lens=lens, before=before)).frames
    assert [frame.name for frame in frames] == [f"frame_{i}.png" for i in range(4)]
    for frame, point in zip(frames, POINTS, strict=True):
        view = frame.load()
        seen = pixels_of(view.camera, point[None])[0]
        np.testing.assert_allclose(dot_of(view.image), seen, atol=0.1)


def test_cameras_are_nerfstudios(tmp_path):
    """Its rotation is Rz(-heading) Rx(pitch) Ry(roll), camera-to-world with OpenGL's axes."""
    frames = open_scene(write(tmp_path)).frames
    for frame, row in zip(frames, rows(LENS), strict=True):
        z, x, y = np.deg2rad([-row["heading"], row["pitch"], row["roll"]])
        turn_z = np.array([[np.cos(z), -np.sin(z), 0], [np.sin(z), np.cos(z), 0], [0, 0, 1]])
        turn_x = np.array([[1, 0, 0], [0, np.cos(x), -np.sin(x)], [0, np.sin(x), np.cos(x)]])
        turn_y = np.array([[np.cos(y), 0, np.sin(y)], [0, 1, 0], [-np.sin(y), 0, np.cos(y)]])
        position = np.array([row["x"], row["y"], row["alt"]])
        seen = (POINTS - position) @ (turn_z @ turn_x @ turn_y)
        focal, center = 45 * WIDTH / 36, np.array([WIDTH / 2 - 6.4, HEIGHT / 2 + 4.8])
        pixels = seen[:, :2] / -seen[:, 2:] * [focal, -focal] + center
        np.testing.assert_allclose(pixels_of(frame.camera), pixels, atol=0.01)


def test_coordinates_of_a_map_are_moved_to_the_origin(tmp_path, caplog):
    entries = rows(LENS, offset=(512_345.6, 5_123_456.7, 300.0))
    near = POINTS - np.mean([shot.position for shot in SHOTS], 0)
    for frame, shot in zip(open_scene(write(tmp_path, entries)).frames, SHOTS, strict=True):
        expected = [pixel_of(point, shot, **LENS) for point in POINTS]
        np.testing.assert_allclose(pixels_of(frame.camera, near), expected, atol=0.01)
    assert "map" in caplog.text


def test_columns_for_the_lens_may_be_missing(tmp_path):
    frame = open_scene(write(tmp_path, columns=[*POSE, "f"])).frames[0]
    assert frame.camera.intrinsics[:2, 2].tolist() == [WIDTH / 2, HEIGHT / 2]


def test_lenses_fit_the_stored_pictures(tmp_path):
    """RealityCapture does not turn pictures by their EXIF orientation."""
    write(tmp_path)
    exif = Image.Exif()
    exif[0x0112] = 6
    picture = Image.open(tmp_path / "frame_0.png")
    picture.save(tmp_path / "frame_0.png", exif=exif)
    frame = open_scene(str(tmp_path)).frames[0]
    assert (frame.camera.height, frame.camera.width) == (HEIGHT, WIDTH)
    assert frame.load().image.shape == (3, HEIGHT, WIDTH)


@pytest.mark.parametrize(
    "changes",
    [
        {"f": "nan"},
        {"f": ""},
        {"f": 0},
        {"x": "inf"},
        {"heading": "north"},
        {"px": 3},
        {"#name": "/etc/no_such.png"},
        {"#name": ".."},
        {"#name": ""},
    ],
    ids=str,
)
def test_a_row_that_cannot_be_used_is_left_out(tmp_path, caplog, changes):
    *good, last = rows(LENS)
    names = [frame.name for frame in open_scene(write(tmp_path, [*good, last | changes])).frames]
    assert names == ["frame_0.png", "frame_1.png", "frame_2.png"]
    assert "cameras.csv" in caplog.text


@pytest.mark.parametrize(
    "text",
    [
        ",".join(COLUMNS),
        ",".join(COLUMNS) + "\n1,2,3",
        ",".join(COLUMNS) + '\na.png,"' + "x" * 200_000,
        "#name,x,x,y,alt,heading,pitch,roll,f\na.png",
        "#name,x,x,y,alt,heading,pitch,roll,f\na.png,1,2,3,4,0,0,0,50",
        "#name,x,y,alt\na.png,1,2,3",
    ],
    ids=lambda text: text[:70],
)
def test_tables_that_describe_no_cameras(tmp_path, text):
    (tmp_path / "cameras.csv").write_text(text)
    save_dot(tmp_path / "a.png", (0, 0), WIDTH, HEIGHT)
    assert "cameras.csv" in complaint_of(open_scene, str(tmp_path))
