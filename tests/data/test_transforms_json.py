"""What a `transforms.json` says of photographs that are there is what is read."""

from pathlib import Path

import numpy as np
import pytest
import torch
from captures import SCENE, view_at
from complaints import complaint_of
from PIL import Image
from posed_folders import read_json, write_json, write_transforms

from extrap_train.data.square_frames import CaptureKeys
from extrap_train.data.transforms_json import read_transforms


@pytest.fixture
def folder(tmp_path):
    write_transforms(tmp_path / "capture", [view_at(azimuth) for azimuth in (0, 30, 60)])
    return tmp_path / "capture"


def test_every_frame_has_a_name_of_its_own(folder):
    content = read_json(folder)
    for frame, name in zip(content["frames"], ("a/1.png", "b/1.png", "a_1.png"), strict=True):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / frame["file_path"]).rename(folder / name)
        frame["file_path"] = name
    write_json(folder, content)
    assert len({frame.name for frame in read_transforms(folder).frames}) == 3


def test_what_was_photographed_is_read(folder):
    sequence = read_transforms(folder)
    assert sequence.name == "capture"
    assert [frame.name for frame in sequence.frames] == ["000.png", "001.png", "002.png"]
    for azimuth, frame in zip((0, 30, 60), sequence.frames, strict=True):
        truth, read = view_at(azimuth), frame.load()
        torch.testing.assert_close(read.camera.world_to_cam, truth.camera.world_to_cam)
        torch.testing.assert_close(read.camera.intrinsics, truth.camera.intrinsics)
        torch.testing.assert_close(read.image, truth.image, rtol=0, atol=0.5 / 255 + 1e-6)
        torch.testing.assert_close(read.depth, truth.depth, rtol=0, atol=6e-4)
        torch.testing.assert_close(read.mask, truth.mask)


def test_a_frame_says_what_it_reads(folder):
    names = ("images/001.png", "mask_001.png", "depth_001.png")
    assert read_transforms(folder).frames[1].files == tuple(folder / name for name in names)


@pytest.mark.parametrize("name", ["images/001.png", "mask_001.png", "depth_001.png"])
def test_a_replaced_file_is_another_capture(folder, name):
    before = CaptureKeys.of(read_transforms(folder))
    with (folder / name).open("ab") as file:
        file.write(b"more")
    after = CaptureKeys.of(read_transforms(folder))
    assert before.content == after.content
    assert before.files != after.files
    assert before.sizes != after.sizes


def test_intrinsics_may_be_common_to_all_or_an_angle(folder):
    content = read_json(folder)
    for frame in content["frames"]:
        for key in ("fl_x", "fl_y", "cx", "cy"):
            del frame[key]
    content["camera_angle_x"] = 2 * np.arctan(0.5)
    del content["h"], content["w"]
    write_json(folder, content)
    k = read_transforms(folder).frames[0].camera.intrinsics
    torch.testing.assert_close(k, torch.tensor([[40.0, 0, 20], [0, 40, 16], [0, 0, 1]]))


@pytest.mark.parametrize("stem", ["plain", "r.a", "v1.5/r.2"])
def test_the_suffix_of_a_picture_may_be_left_out(folder, stem):
    content = read_json(folder)
    for name in (stem, f"{stem}.png"):
        content["frames"][0]["file_path"] = name
        write_json(folder, content)
        picture = folder / f"{stem}.png"
        picture.parent.mkdir(exist_ok=True)
        picture.write_bytes((folder / "images" / "000.png").read_bytes())
        read = read_transforms(folder).frames
        assert picture.name in [frame.name for frame in read]
    picture.rename(folder / stem)
    content["frames"][0]["file_path"] = stem
    write_json(folder, content)
    assert Path(stem).name in [frame.name for frame in read_transforms(folder).frames]


def test_folders_and_files_that_are_links_are_read(folder):
    """As hubs, git-annex and DVC leave them, and as a full disk makes people do."""
    content = read_json(folder)
    (folder / "images").rename(folder.parent / "disk")
    (folder / "images").symlink_to(folder.parent / "disk")
    for name in ("mask_000.png", "depth_000.png", "transforms.json"):
        (folder / name).rename(folder.parent / f"blob {name}")
        (folder / name).symlink_to(f"../blob {name}")
    view = read_transforms(folder).frames[0].load()
    torch.testing.assert_close(view.depth, view_at(0).depth, rtol=0, atol=6e-4)
    assert len(content["frames"]) == 3


@pytest.mark.parametrize(
    "scaled",
    [
        lambda m: m * 2,
        lambda m: m @ np.diag([1.5, 1.5, 1.5, 1]),
        lambda m: np.concatenate([m[:3] * 0.5, [[0, 0, 0, 0.5]]]),
        lambda m: m[:3],
    ],
)
def test_a_scale_of_a_matrix_is_none_of_the_world(folder, scaled):
    content = read_json(folder)
    for frame in content["frames"]:
        frame["transform_matrix"] = scaled(np.array(frame["transform_matrix"])).tolist()
    write_json(folder, content)
    for azimuth, frame in zip((0, 30, 60), read_transforms(folder).frames, strict=True):
        expected = view_at(azimuth).camera.world_to_cam
        torch.testing.assert_close(frame.camera.world_to_cam, expected)


@pytest.mark.parametrize("factor", [0.5, 2, 0.25])
def test_pictures_of_another_size_scale_the_lens(folder, factor):
    for picture in (folder / "images").iterdir():
        image = Image.open(picture)
        image.resize((round(image.width * factor), round(image.height * factor))).save(picture)
    frame = read_transforms(folder).frames[0]
    k = view_at(0).camera.intrinsics * factor
    torch.testing.assert_close(frame.camera.intrinsics[:2], k[:2])
    view = frame.load()
    assert view.image.shape[1:] == view.depth.shape == (32 * factor, 40 * factor)


def test_depth_as_instant_ngp_has_it(folder):
    content = read_json(folder)
    for frame in content["frames"]:
        frame["depth_path"] = frame.pop("depth_file_path")
    write_json(folder, content | {"integer_depth_scale": 0.001, "applied_scale": 7.0})
    depth = read_transforms(folder).frames[0].load().depth
    torch.testing.assert_close(depth, view_at(0).depth, rtol=0, atol=6e-4)
    write_json(folder, content)
    assert "integer_depth_scale" in complaint_of(_load_first, folder)


def test_paths_written_on_windows(folder):
    content = read_json(folder)
    for frame in content["frames"]:
        frame["file_path"] = f".\\images\\{frame['file_path'][-7:]}"
        frame["mask_path"] = f".\\{frame['mask_path']}"
    write_json(folder, content)
    torch.testing.assert_close(read_transforms(folder).frames[0].load().mask, view_at(0).mask)


def test_a_name_in_another_case_is_the_descriptions(folder):
    (folder / "images" / "001.png").rename(folder / "images" / "001.PNG")
    sequence = read_transforms(folder)
    assert [frame.name for frame in sequence.frames] == ["000.png", "001.png", "002.png"]
    assert sequence.frames[1].files[0].name == "001.PNG"


def test_lens_distortion_is_undone(folder):
    content = read_json(folder) | {"k1": 0.3, "k2": -0.05, "p1": 0.002, "p2": 0.001}
    write_json(folder, content)
    view = read_transforms(folder).frames[0].load()
    # Where the distorted picture shows a pixel of the straight one, by the textbook formula.
    k, original = view.camera.intrinsics, view_at(0)
    x = (30.5 - k[0, 2]) / k[0, 0]
    y = (24.5 - k[1, 2]) / k[1, 1]
    r2 = x * x + y * y
    radial = 1 + 0.3 * r2 - 0.05 * r2 * r2
    x_seen = x * radial + 2 * 0.002 * x * y + 0.001 * (r2 + 2 * x * x)
    y_seen = y * radial + 0.002 * (r2 + 2 * y * y) + 2 * 0.001 * x * y
    k_lens = original.camera.intrinsics
    u, v = k_lens[0, 0] * x_seen + k_lens[0, 2], k_lens[1, 1] * y_seen + k_lens[1, 2]
    grid = torch.stack([u / 40 * 2 - 1, v / 32 * 2 - 1]).reshape(1, 1, 1, 2)
    expected = torch.nn.functional.grid_sample(original.image[None], grid, align_corners=False)
    torch.testing.assert_close(view.image[:, 24, 30], expected[0, :, 0, 0], rtol=0, atol=0.01)
    assert view.depth.shape == view.mask.shape == (32, 40)
    assert SCENE.depth(original.camera).unique().numel() >= view.depth.unique().numel()


def test_depth_that_is_not_asked_for_is_not_read(folder):
    frame = read_transforms(folder).frames[0]
    whole = frame.load()
    (folder / "depth_001.png").write_bytes(b"no picture")
    without = frame.load(depth=False)
    assert without.depth is None
    assert torch.equal(without.image, whole.image)
    assert torch.equal(without.mask, whole.mask)


def test_the_scale_of_the_world_is_the_scale_of_its_depth(folder):
    write_json(folder, read_json(folder) | {"applied_scale": 0.5})
    depth = read_transforms(folder).frames[0].load().depth
    torch.testing.assert_close(depth, view_at(0).depth / 2, rtol=0, atol=6e-4)


def test_depth_may_be_an_array(folder):
    content = read_json(folder)
    content["frames"][0]["depth_file_path"] = "depth.npy"
    write_json(folder, content | {"depth_unit_scale_factor": 1.0})
    np.save(folder / "depth.npy", view_at(0).depth.numpy())
    torch.testing.assert_close(read_transforms(folder).frames[0].load().depth, view_at(0).depth)
    np.save(folder / "depth.npy", np.array([{}], dtype=object))
    assert "depth.npy: is not an array of numbers" in complaint_of(_load_first, folder)
    np.save(folder / "depth.npy", np.ones((3, 3)))
    assert "depth.npy: is an array of float64 (3, 3)" in complaint_of(_load_first, folder)


def test_pictures_of_the_same_name_in_two_folders(folder):
    (folder / "left").mkdir()
    (folder / "images" / "001.png").rename(folder / "left" / "000.png")
    content = read_json(folder)
    content["frames"][1]["file_path"] = "left/000.png"
    write_json(folder, content)
    names = [frame.name for frame in read_transforms(folder).frames]
    assert names == ["images_000.png", "images_002.png", "left_000.png"]


def _load_first(folder):
    read_transforms(folder).frames[0].load()
