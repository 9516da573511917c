import contextlib
import logging
import struct
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from captures import view_at
from PIL import Image
from two_views import epipolar_distances

from extrap_train.data.colmap import find_model, read_model
from extrap_train.data.colmap_files import read_model_images
from extrap_train.errors import InputError
from extrap_train.geometry.foreign_cameras import colmap_from_world_to_cam
from extrap_train.views import Camera

PINHOLE = 1


@dataclass
class Entry:
    """An image of a model that is written for a test; all of them share a PINHOLE camera."""

    name: str
    camera: Camera

    @property
    def pose(self) -> list[float]:
        quaternion, translation = colmap_from_world_to_cam(self.camera.world_to_cam.double())
        return [*quaternion.tolist(), *translation.tolist()]

    @property
    def pinhole(self) -> list[float]:
        k = self.camera.intrinsics
        return [k[0, 0].item(), k[1, 1].item(), k[0, 2].item(), k[1, 2].item()]


def write_text(folder, entries):
    camera = entries[0].camera
    numbers = " ".join(map(repr, entries[0].pinhole))
    lines = ["# Camera list", f"7 PINHOLE {camera.width} {camera.height} {numbers}"]
    (folder / "cameras.txt").write_text("\n".join(lines) + "\n")
    lines = ["# Image list"]
    for index, entry in enumerate(entries):
        # The second line of an image lists its points; it may well be empty.
        points = "1.5 2.5 -1 3.5 4.5 12" if index else ""
        lines += [f"{index + 1} {' '.join(map(repr, entry.pose))} 7 {entry.name}", points]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")


def write_binary(folder, entries):
    camera = entries[0].camera
    content = struct.pack("<QiiQQ", 1, 7, PINHOLE, camera.width, camera.height)
    (folder / "cameras.bin").write_bytes(content + struct.pack("<4d", *entries[0].pinhole))
    content = struct.pack("<Q", len(entries))
    for index, entry in enumerate(entries):
        content += struct.pack("<i7di", index + 1, *entry.pose, 7) + entry.name.encode() + b"\0"
        content += struct.pack("<Q", index) + struct.pack("<ddq", 1.5, 2.5, -1) * index
    (folder / "images.bin").write_bytes(content)


@pytest.fixture(params=[write_text, write_binary])
def model(tmp_path, request):
    (tmp_path / "images").mkdir()
    entries = []
    for azimuth in (60, 0, 30):
        view, name = view_at(azimuth), f"at {azimuth:02d}.png"
        pixels = (view.image.permute(1, 2, 0).numpy() * 255).round().astype(np.uint8)
        Image.fromarray(pixels).save(tmp_path / "images" / name)
        entries.append(Entry(name, view.camera))
    request.param(tmp_path, entries)
    return tmp_path


def read(model):
    return read_model(model, model / "images", "capture")


def complaint(model) -> str:
    with pytest.raises(InputError) as caught:
        read(model)
    message = str(caught.value)
    assert "\n" not in message
    assert ";" in message
    return message


def test_what_was_photographed_is_read(model):
    sequence = read(model)
    assert [frame.name for frame in sequence.frames] == ["at 00.png", "at 30.png", "at 60.png"]
    for azimuth, frame in zip((0, 30, 60), sequence.frames, strict=True):
        truth, view = view_at(azimuth), frame.load()
        torch.testing.assert_close(view.camera.world_to_cam, truth.camera.world_to_cam)
        torch.testing.assert_close(view.camera.intrinsics, truth.camera.intrinsics)
        torch.testing.assert_close(view.image, truth.image, rtol=0, atol=0.5 / 255 + 1e-6)
        assert view.depth is None
        assert view.mask is None
        assert frame.files == (model / "images" / frame.name,)


def test_entries_without_a_picture_are_reported(model, caplog):
    (model / "images" / "at 30.png").unlink()
    with caplog.at_level(logging.WARNING):
        assert len(read(model).frames) == 2
    assert "only 2 of the 3 pictures" in caplog.records[0].getMessage()


def test_files_cut_anywhere_are_refused_or_read_in_part(model):
    """Text cut between two images is a smaller model; nothing else goes unnoticed."""
    for file in [*model.glob("*.bin"), *model.glob("*.txt")]:
        whole = file.read_bytes()
        for length in range(0, len(whole), 7):
            file.write_bytes(whole[:length])
            if file.suffix == ".bin":
                complaint(model)
            else:
                with contextlib.suppress(InputError):
                    assert len(read(model).frames) <= 3
        file.write_bytes(whole)


def test_missing_cameras(model):
    for kind in ("bin", "txt"):
        (model / f"cameras.{kind}").unlink(missing_ok=True)
    assert "no such file; export the whole COLMAP model" in complaint(model)


def binary(tmp_path, camera_number=7, model_number=PINHOLE, name=b"a.png", count=1, points=0):
    """A model of one camera and one image, any number of it a lie."""
    parameters = struct.pack("<4d", 50, 50, 20, 16)
    camera = struct.pack("<QiiQQ", count, camera_number, model_number, 40, 32) + parameters
    (tmp_path / "cameras.bin").write_bytes(camera)
    image = struct.pack("<Qi7di", 1, 1, 1, 0, 0, 0, 0, 0, 3, 7) + name + b"\0"
    (tmp_path / "images.bin").write_bytes(image + struct.pack("<Q", points))
    (tmp_path / "images").mkdir(exist_ok=True)
    Image.new("RGB", (40, 32)).save(tmp_path / "images" / "a.png")
    return tmp_path


@pytest.mark.parametrize(
    ("lie", "expected"),
    [
        ({"count": 2**63}, "cameras.bin: is truncated or damaged"),
        ({"points": 2**62}, "images.bin: is truncated or damaged"),
        ({"camera_number": 8}, "a.png names camera 7, which the model does not have"),
        ({"model_number": 99}, "of the model 99"),
        ({"name": b"../a.png"}, "climbs out of its folder"),
        ({"name": b"/a.png"}, "climbs out of its folder"),
        ({"name": b"\xff"}, "is not plain text"),
        ({"name": b"b.png"}, "none of the 1 pictures"),
    ],
)
def test_binary_files_that_lie(tmp_path, lie, expected):
    assert len(read(binary(tmp_path)).frames) == 1
    assert expected in complaint(binary(tmp_path, **lie))


@pytest.mark.parametrize(
    ("file", "line", "expected"),
    [
        ("cameras.txt", "7 PINHOLE 40 32 50 50 20", "has 3 parameters"),
        ("cameras.txt", "7 PINHOLE 40 x 50 50 20 16", "cameras.txt: line 1 is malformed"),
        ("cameras.txt", "7 PINHOLE 0 32 50 50 20 16", "size 32 x 0"),
        ("cameras.txt", "7 FOV 40 32 50 50 20 16 1", "is of the model FOV, and only"),
        (
            "cameras.txt",
            "7 PINHOLE 40 32 50 50 20 16\n7 PINHOLE 40 32 9 9 20 16",
            "cameras.txt: lists camera 7 twice; export",
        ),
        ("images.txt", "1 0 0 0 0 0 0 3 7 a.png\n\n", "is degenerate"),
        ("images.txt", "1 nan 0 0 0 0 0 3 7 a.png\n\n", "is degenerate"),
        ("images.txt", "1 1 0 0 0 0 0 3 seven a.png\n\n", "images.txt: line 1 is malformed"),
        ("images.txt", "\n", "lists no picture"),
    ],
)
def test_text_files_that_make_no_sense(tmp_path, file, line, expected):
    binary(tmp_path)
    for name in ("cameras.bin", "images.bin"):
        (tmp_path / name).unlink()
    (tmp_path / "cameras.txt").write_text("7 PINHOLE 40 32 50 50 20 16\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 3 7 a.png\n\n")
    assert len(read(tmp_path).frames) == 1
    (tmp_path / file).write_text(line)
    assert expected in complaint(tmp_path)


@pytest.fixture
def text_model(tmp_path):
    """Four pictures of two cameras, the second of which no picture uses."""
    (tmp_path / "images").mkdir()
    entries = [Entry(f"{azimuth:02d}.png", view_at(azimuth).camera) for azimuth in (0, 20, 40, 60)]
    for entry in entries:
        Image.new("RGB", (40, 32)).save(tmp_path / "images" / entry.name)
    write_text(tmp_path, entries)
    return tmp_path


@pytest.mark.parametrize(
    "model", ["FOV 40 32 50 50 20 16 1", "EUCM 1 1 1 1 1 1 1 1", "X 0 0", "PINHOLE 40 32 1"]
)
def test_a_camera_that_no_picture_uses_does_not_matter(text_model, model):
    with (text_model / "cameras.txt").open("a") as file:
        file.write(f"8 {model}\n")
    assert len(read(text_model).frames) == 4


def test_a_binary_camera_that_no_picture_uses_does_not_matter(tmp_path):
    """Other models have other numbers of parameters, which are skipped."""
    binary(tmp_path)
    sizes = {7: 5, 10: 12, 11: 16, 12: 4, 13: 5, 16: 6, 17: 2}
    content = struct.pack("<Q", len(sizes) + 1)
    for number, size in sizes.items():
        content += struct.pack(f"<iiQQ{size}d", 100 + number, number, 40, 32, *[1.0] * size)
    own = (tmp_path / "cameras.bin").read_bytes()[8:]
    (tmp_path / "cameras.bin").write_bytes(content + own)
    assert len(read(tmp_path).frames) == 1


@pytest.mark.parametrize(
    ("model", "name"),
    [(7, "FOV"), (10, "THIN_PRISM_FISHEYE"), (12, "SIMPLE_DIVISION"), (16, "EUCM")],
)
def test_models_that_cannot_be_undone_are_named(tmp_path, model, name):
    binary(tmp_path)
    camera = struct.pack("<QiiQQ", 1, 7, model, 40, 32) + struct.pack("<16d", *[1.0] * 16)
    (tmp_path / "cameras.bin").write_bytes(camera)
    assert f"is of the model {name}, and only" in complaint(tmp_path)


@pytest.mark.parametrize(("number", "parameters"), [(14, [30.0, 20, 16]), (15, [30.0, 30, 20, 16])])
def test_equidistant_fisheyes(tmp_path, number, parameters):
    """r = f θ: a direction 0.4 rad off the axis is shown 12 pixels from the centre."""
    binary(tmp_path)
    camera = struct.pack("<QiiQQ", 1, 7, number, 40, 32)
    camera += struct.pack(f"<{len(parameters)}d", *parameters)
    (tmp_path / "cameras.bin").write_bytes(camera)
    picture = np.zeros((32, 40, 3), np.uint8)
    picture[15:17, 31:33] = 255  # around (32, 16)
    Image.fromarray(picture).save(tmp_path / "images" / "a.png")
    view = read(tmp_path).frames[0].load()
    weight = view.image[0] / view.image[0].sum()
    column = float((weight.sum(0) * (torch.arange(40) + 0.5)).sum())
    fx, cx = view.camera.intrinsics[0, 0].item(), view.camera.intrinsics[0, 2].item()
    assert (column - cx) / fx == pytest.approx(np.tan(0.4), abs=0.01)


@pytest.mark.parametrize("factor", [0.5, 0.25, 2])
def test_pictures_of_another_size_scale_the_lens(text_model, factor):
    for picture in (text_model / "images").iterdir():
        Image.new("RGB", (round(40 * factor), round(32 * factor))).save(picture)
    for frame in read(text_model).frames:
        expected = view_at(0).camera.resized(round(32 * factor), round(40 * factor))
        torch.testing.assert_close(frame.camera.intrinsics, expected.intrinsics)
        assert frame.load().image.shape[1:] == (32 * factor, 40 * factor)


def test_pictures_of_another_shape_are_no_other_size(text_model):
    Image.new("RGB", (32, 40)).save(text_model / "images" / "00.png")
    with pytest.raises(InputError, match="32 x 40"):
        read(text_model).frames[0].load()


def test_names_written_elsewhere_are_found(text_model):
    (text_model / "images" / "00.png").rename(text_model / "images" / "00.PNG")
    (text_model / "images" / "left").mkdir()
    (text_model / "images" / "20.png").rename(text_model / "images" / "left" / "20.png")
    file = text_model / "images.txt"
    file.write_text(file.read_text().replace("20.png", "left\\20.png"))
    assert len(read(text_model).frames) == 4


def test_what_is_there_instead_is_said(text_model):
    for picture in (text_model / "images").iterdir():
        picture.rename(picture.with_suffix(".jpg"))
    assert "there is no 00.png; there is 00.jpg" in complaint(text_model)


def test_camera_to_world_poses_are_named(text_model):
    file = text_model / "images.txt"
    lines = file.read_text().splitlines()
    for index, azimuth in enumerate((0, 20, 40, 60)):
        inverse = view_at(azimuth).camera.cam_to_world
        quaternion, translation = colmap_from_world_to_cam(inverse.double())
        pose = " ".join(map(repr, [*quaternion.tolist(), *translation.tolist()]))
        lines[1 + 2 * index] = f"{index} {pose} 7 {azimuth:02d}.png"
    file.write_text("\n".join(lines) + "\n")
    assert "must be world-to-camera" in complaint(text_model)


def test_the_largest_of_several_models_is_read(tmp_path, caplog):
    entries = [Entry(f"{azimuth:02d}.png", view_at(azimuth).camera) for azimuth in (0, 20, 40)]
    for number, part in (("0", entries[:1]), ("1", entries), ("10", entries[:2])):
        (tmp_path / "sparse" / number).mkdir(parents=True)
        (write_text if number == "1" else write_binary)(tmp_path / "sparse" / number, part)
    with caplog.at_level(logging.WARNING):
        assert find_model(tmp_path) == tmp_path / "sparse" / "1"
    assert "0 has 1, 10 has 2" in caplog.text
    assert find_model(tmp_path / "sparse" / "0") == tmp_path / "sparse" / "0"
    (tmp_path / "sparse").rename(tmp_path / "nerfstudio's")
    (tmp_path / "colmap").mkdir()
    (tmp_path / "nerfstudio's").rename(tmp_path / "colmap" / "sparse")
    assert find_model(tmp_path) == tmp_path / "colmap" / "sparse" / "1"


def test_empty_lines_around_the_text_mean_nothing(tmp_path):
    binary(tmp_path)
    for name in ("cameras.bin", "images.bin"):
        (tmp_path / name).unlink()
    (tmp_path / "cameras.txt").write_text("7 PINHOLE 40 32 50 50 20 16\n\n\n")
    (tmp_path / "images.txt").write_text("\n1 1 0 0 0 0 0 3 7 a.png\n\n\n\n")
    assert len(read(tmp_path).frames) == 1


def test_temple_features_lie_on_their_epipolar_lines(shared, tmp_path):
    folder = shared / "data" / "templeSparseRing"
    entries = []
    for line in (folder / "templeSR_par.txt").read_text().splitlines()[1:4]:
        name, *fields = line.split()
        numbers = torch.tensor([float(field) for field in fields]).double()
        world_to_cam = torch.eye(4).double()
        world_to_cam[:3, :3], world_to_cam[:3, 3] = numbers[9:18].reshape(3, 3), numbers[18:]
        intrinsics = numbers[:9].reshape(3, 3)
        # Middlebury's pixel centres lie at whole numbers.
        intrinsics[:2, 2] += 0.5
        entries.append(Entry(name, Camera(world_to_cam, intrinsics, 480, 640)))
    write_text(tmp_path, entries)
    views = [frame.load() for frame in read_model(tmp_path, folder, "temple").frames]
    distances = epipolar_distances(views[:2])
    assert len(distances) > 100
    assert np.median(distances) < 0.5


def test_images_without_lines_of_points_are_not_lost(tmp_path):
    """Every second one would be taken for the points of the one before."""
    views = [view_at(angle) for angle in (0, 20, 40, 60)]
    write_text(tmp_path, [Entry(f"{i}.png", view.camera) for i, view in enumerate(views)])
    file = tmp_path / "images.txt"
    images = [line for line in file.read_text().splitlines() if line.endswith(".png")]
    file.write_text("\n".join(images) + "\n")
    with pytest.raises(InputError, match=r"line 2 is an image where the points .* export"):
        read_model_images(file)
