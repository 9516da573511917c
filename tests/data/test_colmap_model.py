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

from extrap_train.data.colmap_model import read_model
from extrap_train.data.colmap_text import read_text_images
from extrap_train.errors import InputError
from extrap_train.geometry.colmap import colmap_from_world_to_cam
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
    assert "1 of 3 entries have no picture" in caplog.records[0].getMessage()


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
        ({"model_number": 7}, "camera model 7 is none of SIMPLE_PINHOLE"),
        ({"name": b"../a.png"}, "climbs out of its folder"),
        ({"name": b"/a.png"}, "climbs out of its folder"),
        ({"name": b"\xff"}, "is not UTF-8"),
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
        ("cameras.txt", "7 FOV 40 32 50 50 20 16 1", "camera model FOV is none of"),
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
        read_text_images(file)
