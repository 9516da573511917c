"""Metashape's `cameras.xml`: lens, pose, chunk, and what in it is no camera."""

import logging

import numpy as np
import pytest
from complaints import complaint_about, complaint_of
from foreign_exports import POINTS, dot_of, pixels_of, save_dot, shots
from scipy.spatial.transform import Rotation

from extrap_train.data.scene_spec import open_scene
from extrap_train.data.xml_files import read_xml

WIDTH, HEIGHT = 320, 240
LENS = {"f": 400, "cx": -6, "cy": 5, "b1": 12}
DISTORTION = {"k1": -0.2, "k2": 0.1, "k3": 0.05, "k4": -0.02, "p1": 0.02, "p2": -0.01}
SHOTS = shots(4)
"""In the chunk; the pictures have another lens than these."""
ROTATION = Rotation.from_rotvec([0.5, -1.0, 0.3]).as_matrix()
SCALE, TRANSLATION = 12.354, np.array([3.0, -2.0, 1.0])


def manual_pixel(point, shot, f, cx, cy, b1=0, k1=0, k2=0, k3=0, k4=0, p1=0, p2=0):
    """The frame camera of Metashape's manual, appendix "Camera models"."""
    x, y = shot.directions(point)
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3 + k4 * r2**4
    u = x * radial + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y
    v = y * radial + p2 * (r2 + 2 * y * y) + 2 * p1 * x * y
    return np.array([WIDTH / 2 + cx + u * f + u * b1, HEIGHT / 2 + cy + v * f])


def calibration(kind="frame", given="adjusted", **values):
    parts = "".join(f"<{key}>{value}</{key}>" for key, value in values.items())
    size = f'<resolution width="{WIDTH}" height="{HEIGHT}"/>'
    return f'<calibration type="{kind}" class="{given}">{size}{parts}</calibration>'


def sensor(calibrations, kind="frame"):
    return f'<sensor id="0" label="a camera" type="{kind}">{calibrations}</sensor>'


def camera(index, shot, matrix=None, attributes=""):
    numbers = " ".join(map(str, shot.opencv_matrix.flat if matrix is None else matrix))
    return (
        f'<camera id="{index}" sensor_id="0" component_id="0" label="IMG_{index}" {attributes}>'
        f"<transform>{numbers}</transform><orientation>1</orientation></camera>"
    )


def transform(translation=TRANSLATION):
    rotation = " ".join(map(str, ROTATION.flat))
    offset = " ".join(map(str, translation))
    return (
        f'<transform><rotation locked="true">{rotation}</rotation><translation>{offset}'
        f"</translation><scale>{SCALE}</scale></transform>"
    )


def document(sensors, cameras, of_component="", of_chunk=""):
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<document version="2.0.0"><chunk label="Chunk 1">'
        f"<sensors>{sensors}</sensors><components><component id='0'>{of_component}</component>"
        f"</components><cameras><group>{cameras}</group></cameras>{of_chunk}</chunk></document>"
    )


def write(folder, sensors=None, cameras=None, lens=LENS, **transforms):
    """The pictures show `POINTS`, one each, through a lens."""
    shown = {key: value for key, value in lens.items() if key != "b2"}
    for index, (shot, point) in enumerate(zip(SHOTS, POINTS, strict=True)):
        pixel = manual_pixel(point, shot, **shown)
        save_dot(folder / f"images/IMG_{index}.png", pixel, WIDTH, HEIGHT)
    sensors = sensors or sensor(calibration(given="initial", f=1) + calibration(**lens))
    cameras = cameras or "".join(camera(i, shot) for i, shot in enumerate(SHOTS))
    (folder / "cameras.xml").write_text(document(sensors, cameras, **transforms))
    return str(folder)


def in_world(points):
    return SCALE * points @ ROTATION.T + TRANSLATION


@pytest.mark.parametrize("lens", [LENS, LENS | DISTORTION, LENS | {"b2": -0.3}], ids=len)
def test_dots_are_where_the_camera_says(tmp_path, lens):
    frames = open_scene(write(tmp_path, lens=lens)).frames
    assert [frame.name for frame in frames] == [f"IMG_{i}.png" for i in range(4)]
    for frame, point in zip(frames, POINTS, strict=True):
        view = frame.load()
        seen = pixels_of(view.camera, point[None])[0]
        np.testing.assert_allclose(dot_of(view.image), seen, atol=0.1)


def test_tangential_coefficients_could_be_told_apart():
    """Or the test above would not notice that they are the other way round in OpenCV."""
    swapped = DISTORTION | {"p1": DISTORTION["p2"], "p2": DISTORTION["p1"]}
    pairs = zip(SHOTS, POINTS, strict=True)
    apart = [
        manual_pixel(p, s, **LENS, **DISTORTION) - manual_pixel(p, s, **LENS, **swapped)
        for s, p in pairs
    ]
    assert max(map(np.linalg.norm, apart)) > 1


@pytest.mark.parametrize("place", ["of_component", "of_chunk"])
def test_the_chunk_leads_to_the_world(tmp_path, place):
    frames = open_scene(write(tmp_path, **{place: transform()})).frames
    for frame, shot in zip(frames, SHOTS, strict=True):
        expected = [manual_pixel(point, shot, **LENS) for point in POINTS]
        np.testing.assert_allclose(pixels_of(frame.camera, in_world(POINTS)), expected, atol=0.01)


def test_cameras_are_nerfstudios_but_for_its_turned_and_scaled_world(tmp_path):
    """nerfstudio divides the translation by the scale, leaves the latter out, permutes the world's
    axes and negates the camera's second and third.
    """
    frames = open_scene(write(tmp_path, of_component=transform())).frames
    component = np.eye(4)
    component[:3, :3], component[:3, 3] = ROTATION, TRANSLATION / SCALE
    for frame, shot in zip(frames, SHOTS, strict=True):
        cam_to_world = (component @ shot.opencv_matrix)[[2, 0, 1, 3]] * [1, -1, -1, 1]
        scaled = in_world(POINTS)[:, [2, 0, 1]] / SCALE
        seen = (scaled - cam_to_world[:3, 3]) @ cam_to_world[:3, :3]
        focal, center = np.array([412, -400]), np.array([WIDTH / 2 - 6, HEIGHT / 2 + 5])
        pixels = seen[:, :2] / -seen[:, 2:] * focal + center
        np.testing.assert_allclose(pixels_of(frame.camera, in_world(POINTS)), pixels, atol=0.01)


def test_geocentric_coordinates_are_moved_to_the_origin(tmp_path, caplog):
    far = np.array([-2499366.43, -4256836.52, 4029217.97])
    frames = open_scene(write(tmp_path, of_component=transform(far))).frames
    centers = [SCALE * ROTATION @ shot.position for shot in SHOTS]
    points = SCALE * POINTS @ ROTATION.T - np.mean(centers, 0)
    for frame, shot in zip(frames, SHOTS, strict=True):
        expected = [manual_pixel(point, shot, **LENS) for point in POINTS]
        np.testing.assert_allclose(pixels_of(frame.camera, points), expected, atol=0.01)
    assert "map" in caplog.text


def test_a_fisheye_lens(tmp_path):
    fisheye = sensor(calibration("fisheye", f=300, k1=0.1, k2=-0.05, k3=0.02), "fisheye")
    folder = write(tmp_path, sensors=fisheye)
    for index, (shot, point) in enumerate(zip(SHOTS, POINTS, strict=True)):
        x, y = shot.directions(point)
        angle = np.arctan(np.hypot(x, y))
        radial = angle / max(np.hypot(x, y), 1e-12)
        radial *= 1 + 0.1 * angle**2 - 0.05 * angle**4 + 0.02 * angle**6
        pixel = WIDTH / 2 + 300 * x * radial, HEIGHT / 2 + 300 * y * radial
        save_dot(tmp_path / f"images/IMG_{index}.png", pixel, WIDTH, HEIGHT)
    for frame, point in zip(open_scene(folder).frames, POINTS, strict=True):
        view = frame.load()
        seen = pixels_of(view.camera, point[None])[0]
        np.testing.assert_allclose(dot_of(view.image), seen, atol=0.1)


@pytest.mark.parametrize("calibrated", [False, True])
def test_a_panorama(tmp_path, calibrated):
    """The manual's spherical camera; each dot is in the views that look that way."""
    width, height = 360, 180
    size = f'<resolution width="{width}" height="{height}"/>'
    own = f'<calibration type="spherical">{size}<f>57.2957795</f></calibration>'
    folder = write(tmp_path, sensors=sensor(size + own * calibrated, "spherical"))
    point = np.array([0.9, 0.1, 0.4])
    for index, shot in enumerate(SHOTS):
        x, y = shot.directions(point)
        assert (point - shot.position) @ shot.forward > 0
        pixel = np.arctan2(x, 1), np.arctan2(y, np.hypot(x, 1))
        pixel = np.array([width / 2, height / 2]) + width / 2 / np.pi * np.array(pixel)
        save_dot(tmp_path / f"images/IMG_{index}.png", pixel, width, height)
    views = [frame.load() for frame in open_scene(folder).frames]
    assert len(views) == 6 * len(SHOTS)
    shown = [view for view in views if view.image[:, 9:-9, 9:-9].max() > 0.8]
    assert len(shown) >= len(SHOTS)
    for view in shown:
        seen = pixels_of(view.camera, point[None])[0]
        # A view stretches what is round in the panorama, which moves its centroid outwards.
        np.testing.assert_allclose(dot_of(view.image), seen, atol=0.4)


@pytest.mark.parametrize(
    "entry",
    [
        '<camera id="3" sensor_id="0" label="IMG_3"/>',
        '<camera id="3" sensor_id="0" label="IMG_3&#10;x"/>',
        camera(3, SHOTS[3], attributes='enabled="false"'),
        camera(3, SHOTS[3], matrix=[1] * 15),
        camera(3, SHOTS[3], matrix=["nan"] * 16),
        camera(3, SHOTS[3], matrix=["x"] * 16),
        camera(3, SHOTS[3]).replace('component_id="0"', 'component_id="1"'),
        camera(3, SHOTS[3]).replace('sensor_id="0"', 'sensor_id="7"'),
    ],
    ids=["not aligned", "lines", "disabled", "short", "nan", "text", "component", "sensor"],
)
def test_a_camera_that_cannot_be_used_is_left_out_by_name(tmp_path, caplog, entry):
    cameras = "".join(camera(i, SHOTS[i]) for i in range(3)) + entry
    with caplog.at_level(logging.WARNING):
        assert len(open_scene(write(tmp_path, cameras=cameras)).frames) == 3
    assert "IMG_3" in caplog.text
    assert all(message.isprintable() for message in caplog.messages)


@pytest.mark.parametrize("label", ["../IMG_1", "", "bell&#7;", "no such picture"])
def test_labels_lead_nowhere_else(tmp_path, label):
    cameras = camera(0, SHOTS[0]) + camera(5, SHOTS[1]).replace("IMG_5", label)
    write(tmp_path, cameras=cameras)
    if "#7" in label:  # no character of XML
        complaint_about(read_xml, tmp_path / "cameras.xml")
    else:
        found = [frame.name for frame in open_scene(str(tmp_path)).frames]
        assert found == (["IMG_0.png", "IMG_1.png"] if "IMG" in label else ["IMG_0.png"])


@pytest.mark.parametrize(
    "sensors",
    [
        sensor(calibration(**LENS), "cylindrical"),
        sensor(calibration(f=50), "spherical"),
        sensor(""),
        sensor(calibration()),
        sensor(calibration(f="nan")),
        sensor(calibration(f="x")),
        sensor(calibration(**LENS, b2=9)),
        sensor(calibration(**LENS, b2="nan")),
        sensor(calibration(**LENS, p3=0.1)),
        sensor(calibration("fisheye", **LENS, p1=0.1), "fisheye"),
        sensor(calibration(**LENS).replace(f'"{WIDTH}"', '"-4"')),
        sensor(calibration(**LENS).replace("resolution", "size")),
    ],
    ids=str,
)
def test_sensors_that_cannot_be_used(tmp_path, sensors):
    complaint_of(open_scene, write(tmp_path, sensors=sensors))


@pytest.mark.parametrize(
    "text",
    [
        "<document><chunk>",
        "<document><chunk/><chunk/></document>",
        "<document><chunk/></document>",
        document(
            sensor(calibration(**LENS)),
            camera(0, SHOTS[0]),
            "<transform><scale>x</scale></transform>",
        ),
        "<?xml version='1.0' encoding='no-such'?><document><chunk/></document>",
        '<!DOCTYPE d [<!ENTITY a "aa">]><document><chunk>&a;</chunk></document>',
        '<!DOCTYPE d SYSTEM "file:///etc/passwd"><document><chunk/></document>',
        "<document><chunk>" + "<a>" * 100_000,
    ],
    ids=lambda text: text[:60],
)
def test_files_that_describe_no_cameras(tmp_path, text):
    write(tmp_path)
    (tmp_path / "cameras.xml").write_text(text)
    assert "cameras.xml" in complaint_of(open_scene, str(tmp_path))


def test_two_descriptions_are_refused(tmp_path):
    write(tmp_path)
    (tmp_path / "old.xml").write_bytes((tmp_path / "cameras.xml").read_bytes())
    assert "old.xml" in complaint_of(open_scene, str(tmp_path))
    (tmp_path / "old.xml").write_text("<settings/>")
    assert len(open_scene(str(tmp_path)).frames) == 4
