"""Photographs without cameras: rendered pictures whose cameras are known."""

import logging
import math
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from aligned_cameras import pose_errors
from captures import view_at
from PIL import Image
from posed_folders import write_transforms
from traced_scenes import SCENES, orbit_camera, render

from extrap_train.data import estimated_poses
from extrap_train.data.image_files import to_eight_bits, upright_photograph
from extrap_train.data.scene_spec import open_scene
from extrap_train.data.structure_from_motion import EXHAUSTIVE, NEIGHBOURS, pairs_to_match
from extrap_train.errors import InputError

pytest.importorskip("pycolmap", reason="needs pycolmap: the extra `poses`")

HEIGHT, WIDTH = 240, 320
FOCAL = 1.2 * WIDTH
TURNS = {1: Image.Transpose.ROTATE_180, 2: Image.Transpose.ROTATE_90}
"""How two of the pictures are stored; their EXIF orientations undo it."""
ORIENTATIONS = {1: 3, 2: 6}


def _rendered():
    views = []
    for number in range(5):
        square = orbit_camera(12.0 * number, WIDTH)
        lens = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
        camera = replace(square, intrinsics=lens, height=HEIGHT, width=WIDTH)
        views.append(replace(render(SCENES["box on the ground"], camera), name=f"{number}.JPG"))
    return views


def _exif(orientation=1, focal_35mm=None):
    exif = Image.Exif()
    exif[0x0112] = orientation
    if focal_35mm is not None:
        exif.get_ifd(0x8769)[0xA405] = focal_35mm
    return exif


def _save_noise(path, seed):
    noise = np.random.default_rng(seed).integers(0, 255, (12, 16, 3), dtype=np.uint8)
    Image.fromarray(noise).resize((WIDTH, HEIGHT)).save(path)


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    """A folder of photographs, some of them turned, one of something else, and the true views."""
    folder, views = tmp_path_factory.mktemp("photographs") / "my scene", _rendered()
    folder.mkdir()
    (folder / "notes.txt").write_text("no picture")
    _save_noise(folder / "other.png", seed=0)
    focal_35mm = round(FOCAL / math.hypot(HEIGHT, WIDTH) * math.hypot(24, 36))
    for number, view in enumerate(views):
        picture = Image.fromarray(to_eight_bits(view.image).transpose(1, 2, 0))
        if number in TURNS:
            picture = picture.transpose(TURNS[number])
        exif = _exif(ORIENTATIONS.get(number, 1), focal_35mm)
        picture.save(folder / view.name, "JPEG", quality=95, exif=exif)
    return folder, views


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory):
    """A cache of this module's own."""
    folder = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder))
        yield folder / "extrap-train" / "poses"


@pytest.fixture(scope="module")
def opened(photographs):
    return open_scene(str(photographs[0]))


@pytest.fixture
def no_mapping(monkeypatch):
    """Ends what would estimate cameras."""

    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(estimated_poses, "_run", stop)


def test_cameras_are_found_up_to_a_similarity(photographs, opened):
    views = photographs[1]
    assert [frame.name for frame in opened.frames] == [view.name for view in views]
    errors = pose_errors([f.camera for f in opened.frames], [v.camera for v in views])
    assert np.median(errors.rotation_deg) < 0.5
    assert np.median(errors.translation) < 0.01  # of the orbit's radius
    for frame in opened.frames:
        assert frame.camera.intrinsics[0, 0] == pytest.approx(FOCAL, rel=0.02)


def test_turned_photographs_are_read_upright(photographs, opened):
    for frame, view in zip(opened.frames, photographs[1], strict=True):
        image = frame.load().image
        assert image.shape == view.image.shape
        assert (image - view.image).abs().mean() < 0.05  # JPEG; another view differs by 0.15


@pytest.mark.usefixtures("opened", "no_mapping")
def test_photographs_keep_their_cameras_when_masks_are_put_beside_them(photographs, tmp_path):
    """Masks are not photographs, and upright as the pictures are shown."""
    folder = tmp_path / photographs[0].name
    shutil.copytree(photographs[0], folder)
    (folder / "masks").mkdir()
    half = np.zeros((HEIGHT, WIDTH), np.uint8)
    half[: HEIGHT // 2] = 255
    for number, view in enumerate(photographs[1]):
        name = f"masks/{view.name}.png" if number else "0_mask.png"
        Image.fromarray(half).save(folder / name)
    for frame in open_scene(str(folder)).frames:
        mask = frame.load().mask
        assert mask[: HEIGHT // 2].min() == 1
        assert mask[HEIGHT // 2 + 2 :].max() < 0.1  # but for the lens that is undone


def test_what_cannot_be_placed_is_named_in_one_warning(photographs, opened, caplog):
    with caplog.at_level(logging.WARNING):
        again = open_scene(str(photographs[0]))
    (warning,) = caplog.messages
    assert "other.png" in warning
    assert "\n" not in warning
    assert len(again.left_out) == 1
    assert again.listed == (*(view.name for view in photographs[1]), "other.png")


@pytest.mark.usefixtures("no_mapping")
def test_cameras_are_found_again_until_a_picture_changes(photographs, opened, cache, tmp_path):
    folder = photographs[0]
    moved = shutil.copytree(folder, tmp_path / folder.name)
    again = open_scene(str(moved))
    for frame, known in zip(again.frames, opened.frames, strict=True):
        assert torch.equal(frame.camera.world_to_cam, known.camera.world_to_cam)
    before = sorted(cache.iterdir())
    _save_noise(moved / "other.png", seed=1)
    with pytest.raises(KeyboardInterrupt):
        open_scene(str(moved))
    assert sorted(cache.iterdir()) == before  # an interrupted estimate leaves nothing


@pytest.mark.usefixtures("no_mapping")
def test_camera_files_come_first(photographs, tmp_path):
    shutil.copy(photographs[0] / "other.png", tmp_path)
    write_transforms(tmp_path, [view_at(0), view_at(30)])
    assert len(open_scene(str(tmp_path)).frames) == 2


def test_without_pycolmap(photographs, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(estimated_poses.importlib.util, "find_spec", lambda name: None)
    _expect_error(photographs[0], r"extrap-train\[poses\]")


@pytest.mark.usefixtures("no_mapping")
def test_too_few_photographs(tmp_path):
    _save_noise(tmp_path / "a.png", seed=2)
    _save_noise(tmp_path / "b.png", seed=3)
    (tmp_path / "c.jpg").write_bytes(b"\xff\xd8 cut off")
    _expect_error(tmp_path, "2 readable photographs")


@pytest.mark.parametrize("focal", [0.0, 10.0, 1e5, math.nan])
def test_a_focal_length_that_no_lens_has(photographs, opened, tmp_path, monkeypatch, cache, focal):
    (stored,) = (path for path in cache.iterdir() if path.is_dir())

    def run(work, count):
        import pycolmap

        model = pycolmap.Reconstruction(str(stored / "sparse" / "0"))
        for camera in model.cameras.values():
            camera.params = [focal, *camera.params[1:]]
        (work / "sparse" / "0").mkdir(parents=True)
        model.write(work / "sparse" / "0")

    monkeypatch.setattr(estimated_poses, "_run", run)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    _expect_error(photographs[0], "focal length")


def test_a_failing_process_is_one_line(tmp_path, monkeypatch):
    for seed in range(3):
        _save_noise(tmp_path / f"{seed}.png", seed=seed + 10)
    monkeypatch.setattr(estimated_poses, "write_job", lambda cameras, work: None)
    _expect_error(tmp_path, "pycolmap failed")


@pytest.mark.usefixtures("no_mapping")
@pytest.mark.parametrize(
    "file",
    [
        "sparse/0/cameras.bin",
        "colmap/sparse/0/cameras.txt",
        "Transforms.json",
        "transforms_train.json",
        "cameras.npz",
        "poses_bounds.npy",
        "../frame_annotations.jgz",
    ],
)
def test_part_of_a_description_of_cameras_is_not_passed_over(tmp_path, file):
    folder = tmp_path / "capture"
    (folder / "images").mkdir(parents=True)
    for seed in range(3):
        _save_noise(folder / "images" / f"{seed}.png", seed)
    (folder / file).parent.mkdir(parents=True, exist_ok=True)
    (folder / file).write_bytes(b"")
    _expect_error(folder, Path(file).name)


@pytest.mark.usefixtures("no_mapping")
def test_what_lies_in_the_cache_is_used_only_as_it_was_written(photographs, opened, cache):
    (stored,) = (path for path in cache.iterdir() if path.is_dir())
    for file in ("images.bin", "cameras.bin"):
        path = stored / "sparse" / "0" / file
        before = path.read_bytes()
        path.write_bytes(before[:-30] + bytes([before[-30] ^ 1]) + before[-29:])
        with pytest.raises(KeyboardInterrupt):  # it would be estimated again
            open_scene(str(photographs[0]))
        path.write_bytes(before)
    assert len(open_scene(str(photographs[0])).frames) == len(opened.frames)


def test_a_cache_that_is_no_folder_is_one_line(photographs, tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    _expect_error(photographs[0], "XDG_CACHE_HOME")


def test_photographs_of_different_things_and_nothing_is_run_from_the_current_folder(
    tmp_path, monkeypatch
):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    for name in ("pycolmap", "json", "dataclasses"):
        (tmp_path / f"{name}.py").write_text(f"open({str(tmp_path / 'EXECUTED')!r}, 'w')")
    for seed in range(3):
        _save_noise(tmp_path / f"{seed}.png", seed=seed)
    monkeypatch.chdir(tmp_path)
    _expect_error(".", "too little in common")  # said once pycolmap has looked at them
    assert not (tmp_path / "EXECUTED").exists()


@pytest.mark.usefixtures("no_mapping")
def test_names_and_links_that_cannot_be_read_are_left_out_by_name(photographs, tmp_path, caplog):
    """Before anything is estimated, which is interrupted here."""
    for view in photographs[1][:3]:
        shutil.copy(photographs[0] / view.name, tmp_path)
    (tmp_path / "linked.png").symlink_to("../.git/annex/x")
    shutil.copy(photographs[0] / "other.png", os.fsencode(tmp_path) + b"/Bild \xe4.png")
    with caplog.at_level(logging.WARNING), pytest.raises(KeyboardInterrupt):
        open_scene(str(tmp_path))
    annex, latin = sorted(caplog.messages, key=lambda said: "UTF-8" in said)
    assert "linked.png" in annex
    assert "annex" in annex
    assert "UTF-8" in latin


def _expect_error(folder, match):
    with pytest.raises(InputError, match=match) as caught:
        open_scene(str(folder))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("focal_35mm", [None, 0, math.nan])
def test_no_focal_length_in_exif(tmp_path, focal_35mm):
    Image.new("L", (40, 30)).save(tmp_path / "a.jpg", exif=_exif(6))
    assert upright_photograph(tmp_path / "a.jpg") == ((40, 30), None)


def test_exif_focal_length_is_of_the_diagonal(tmp_path):
    Image.new("L", (40, 30)).save(tmp_path / "a.jpg", exif=_exif(8, 43))
    size, focal = upright_photograph(tmp_path / "a.jpg")
    assert size == (40, 30)
    assert focal == pytest.approx(50 * 43 / math.hypot(24, 36))


def test_pairs_of_few_and_of_many():
    few = [pair for pairs in pairs_to_match(EXHAUSTIVE) for pair in pairs]
    assert len(set(few)) == EXHAUSTIVE * (EXHAUSTIVE - 1) // 2
    many = [pair for pairs in pairs_to_match(10 * EXHAUSTIVE) for pair in pairs]
    gaps = {j - i for i, j in many}
    assert {*range(1, NEIGHBOURS + 1), 16, 512} <= gaps
    assert len(many) < 20 * 10 * EXHAUSTIVE
