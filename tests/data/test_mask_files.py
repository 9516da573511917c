"""Masks are found by the names that COLMAP, nerfstudio and background removers give them."""

import logging
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from captures import view_at
from complaints import complaint_of
from PIL import Image
from posed_folders import read_json, to_bytes, write_json, write_transforms
from test_colmap_model import Entry, write_binary

from extrap_train.data.colmap import read_model
from extrap_train.data.estimated_poses import find_pictures
from extrap_train.data.scene_spec import open_scene
from extrap_train.data.sequences import FrameSequence

AZIMUTHS = (0, 30, 60)
HEIGHT, WIDTH = 32, 40


@pytest.fixture
def posed(tmp_path: Path) -> Path:
    """A folder with a `transforms.json` that names no mask."""
    folder = tmp_path / "capture"
    write_transforms(folder, [view_at(azimuth) for azimuth in AZIMUTHS])
    content = read_json(folder)
    for frame in content["frames"]:
        (folder / frame.pop("mask_path")).unlink()
    write_json(folder, content)
    return folder


@pytest.fixture
def colmap(tmp_path: Path) -> Path:
    """A COLMAP model with pictures in folders of their own."""
    entries = []
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    for azimuth in AZIMUTHS:
        view, name = view_at(azimuth), f"left/{azimuth}.JPG"
        (tmp_path / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(to_bytes(view.image.permute(1, 2, 0))).save(tmp_path / "images" / name)
        entries.append(Entry(name, view.camera))
    write_binary(tmp_path / "sparse" / "0", entries)
    return tmp_path


def write_masks(folder: Path, *names: str, times: int = 1) -> list[Path]:
    """Each view's true mask, its pixels repeated; made of the names' first, second and so on."""
    files = [folder / name for name in names]
    for file, azimuth in zip(files, AZIMUTHS, strict=False):
        file.parent.mkdir(parents=True, exist_ok=True)
        pixels = to_bytes(view_at(azimuth).mask).repeat(times, 0).repeat(times, 1)
        Image.fromarray(pixels).save(file)
    return files


def require_true_masks(sequence: FrameSequence) -> None:
    for azimuth, frame in zip(AZIMUTHS, sequence.frames, strict=True):
        assert frame.has_mask
        mask = frame.load(depth=False).mask
        torch.testing.assert_close(mask, view_at(azimuth).mask, rtol=0, atol=0.5 / 255)


@pytest.mark.parametrize(
    "place", ["masks/left/{}.JPG.png", "masks/left/{}.png", "masks/images/left/{}.JPG.png"]
)
def test_masks_of_a_colmap_model(colmap, place, caplog):
    files = write_masks(colmap, *map(place.format, AZIMUTHS))
    sequence = open_scene(str(colmap))
    require_true_masks(sequence)
    assert [frame.files[1] for frame in sequence.frames] == files
    assert not caplog.records


def test_masks_lie_beside_a_link_to_the_pictures(colmap):
    (colmap / "images").rename(colmap / "elsewhere")
    (colmap / "images").symlink_to(colmap / "elsewhere")
    write_masks(colmap, *(f"masks/left/{azimuth}.JPG.png" for azimuth in AZIMUTHS))
    require_true_masks(open_scene(str(colmap)))


@pytest.mark.parametrize(
    "place",
    ["masks/{}.png", "masks/{}_mask.png", "masks/images/{}.png", "masks/{}.PNG"],
)
def test_masks_of_a_transforms_folder(posed, place):
    write_masks(posed, *(place.format(f"{index:03d}") for index in range(3)))
    require_true_masks(open_scene(str(posed)))


def test_masks_of_smaller_pictures(posed):
    content = read_json(posed)
    (posed / "images").rename(posed / "images_2")
    for frame in content["frames"]:
        frame["file_path"] = frame["file_path"].replace("images", "images_2")
    write_json(posed, content)
    write_masks(posed, *(f"masks/{index:03d}.png" for index in range(3)), times=2)
    require_true_masks(open_scene(str(posed)))
    others = write_masks(posed, *(f"masks_2/{index:03d}.png" for index in range(3)))
    assert [frame.files[1] for frame in open_scene(str(posed)).frames] == others


def test_a_mask_beside_its_picture_is_no_photograph(posed):
    write_masks(posed, *(f"images/{index:03d}_mask.png" for index in range(3)))
    require_true_masks(open_scene(str(posed)))
    assert find_pictures(posed / "images") == ["000.png", "001.png", "002.png"]
    (posed / "images" / "001.png").unlink()
    assert "001_mask.png" in find_pictures(posed / "images"), "of no picture: one itself"


def test_what_the_description_names_comes_first(posed):
    write_masks(posed, *(f"masks/{index:03d}.png" for index in range(3)))
    (named,) = write_masks(posed, "named.png")
    content = read_json(posed)
    content["frames"][0]["mask_path"] = "named.png"
    write_json(posed, content)
    assert named in open_scene(str(posed)).frames[0].files


def test_a_coloured_cut_out_is_the_mask_of_what_it_shows(posed):
    """Background removers leave the picture's own colours, dark ones too."""
    view = view_at(0)
    cut_out = np.dstack([to_bytes(view.image.permute(1, 2, 0)) // 4, to_bytes(view.mask)])
    (posed / "masks").mkdir()
    Image.fromarray(cut_out).save(posed / "masks" / "000.png")
    mask = open_scene(str(posed)).frames[0].load().mask
    torch.testing.assert_close(mask, view.mask, rtol=0, atol=0.5 / 255)


def test_pictures_without_a_mask_are_said_where_others_have_one(posed, caplog):
    write_masks(posed, "masks/000.png")
    frames = open_scene(str(posed)).frames
    assert [frame.has_mask for frame in frames] == [True, False, False]
    (record,) = caplog.records
    assert "1 of 3" in record.getMessage()
    assert "001_mask.png" in record.getMessage()


def test_a_folder_of_masks_that_fit_no_picture_is_said(posed, caplog):
    write_masks(posed, "masks/frame_1.png")
    assert not any(frame.has_mask for frame in open_scene(str(posed)).frames)
    (record,) = caplog.records
    assert str(posed / "masks") in record.getMessage()


def _rename_pictures(folder: Path, *names: str) -> list[Path | None]:
    """The mask of each of a transforms folder's pictures, called so now."""
    content = read_json(folder)
    for frame, name in zip(content["frames"], names, strict=True):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / frame["file_path"]).rename(folder / name)
        frame["file_path"] = name
    write_json(folder, content)
    frames = [frame for frame in open_scene(str(folder)).frames if frame.has_mask]
    masks = {frame.name: frame.files[1] for frame in frames}
    return [masks.get(Path(name).name, masks.get(name.replace("/", "_"))) for name in names]


def test_folders_of_other_pictures_have_masks_of_their_own(posed):
    first, other = write_masks(posed, "masks/1.png", "masks/images_right/1.png.png")
    names = ("images/1.png", "images_right/1.png", "images_left/1.png")
    assert _rename_pictures(posed, *names) == [first, other, None]


def test_the_whole_path_comes_first(posed):
    first, _ = write_masks(posed, "masks/images_2/1.png.png", "masks_2/1.png")
    assert _rename_pictures(posed, *(f"images_2/{name}.png" for name in "123"))[0] == first


def test_another_photograph_is_no_mask(posed):
    names = ("images/anna.png", "images/anna_mask.png", "images/bob.png")
    assert _rename_pictures(posed, *names) == [None, None, None]
    (mask,) = write_masks(posed, "masks/anna_mask.png.png")
    frames = open_scene(str(posed)).frames
    assert [frame.files[1] for frame in frames if frame.has_mask] == [mask]


def test_a_file_without_an_ending_is_no_mask(posed):
    (posed / "masks").mkdir()
    shutil.copy(posed / "images" / "000.png", posed / "masks" / "000")
    assert not open_scene(str(posed)).frames[0].has_mask


def test_captures_side_by_side_share_no_masks(colmap):
    write_masks(colmap, *(f"masks/left/{azimuth}.png" for azimuth in AZIMUTHS))
    for name, has_mask in (("images1", False), ("images2", False), ("images_2", True)):
        shutil.copytree(colmap / "images", colmap / name)
        frames = read_model(colmap / "sparse" / "0", colmap / name, "one").frames
        assert {frame.has_mask for frame in frames} == {has_mask}


def test_one_mask_of_two_pictures_is_refused(posed):
    (mask,) = write_masks(posed, "masks/1.png")
    said = complaint_of(
        lambda: _rename_pictures(posed, "images/1.png", "images_2/1.png", "images/2.png")
    )
    for part in (mask, "images/1.png", "images_2/1.png"):
        assert str(part) in said


@pytest.mark.parametrize("size", [(20, 20), (HEIGHT, WIDTH), (WIDTH * 2, HEIGHT)])
def test_a_mask_of_another_shape_is_refused_by_name(posed, size):
    (file,) = write_masks(posed, "masks/000.png")
    Image.open(file).resize(size).save(file)
    said = complaint_of(lambda: open_scene(str(posed)).frames[0].load())
    assert str(file) in said
    assert f"{HEIGHT} x {WIDTH}" in said


def test_a_mask_that_selects_nothing_is_refused_by_name(posed):
    (file,) = write_masks(posed, "masks/000.png")
    Image.new("L", (WIDTH, HEIGHT)).save(file)
    assert str(file) in complaint_of(lambda: open_scene(str(posed)).frames[0].load())


def test_masks_that_select_everything_are_said_once(posed, caplog):
    files = write_masks(posed, *(f"masks/{index:03d}.png" for index in range(3)))
    for file in files:
        Image.new("L", (WIDTH, HEIGHT), 255).save(file)
    with caplog.at_level(logging.WARNING):
        for frame in open_scene(str(posed)).frames:
            assert frame.load().mask.min() == 1
    (record,) = caplog.records
    assert str(files[0].parent) in record.getMessage()
