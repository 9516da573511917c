"""A capture is the same whether its folder is named from here or from the root."""

from collections.abc import Callable
from pathlib import Path

import pytest
from captures import view_at, write_capture
from PIL import Image
from posed_folders import to_bytes, write_transforms
from test_colmap_model import Entry, write_binary

from extrap_train.data.scene_spec import open_scene
from extrap_train.data.square_frames import CaptureKeys
from extrap_train.tasks.scene_inputs import frame_digest

_AZIMUTHS = (0, 30, 60)


def _write_transforms(folder: Path) -> None:
    write_transforms(folder, [view_at(azimuth) for azimuth in _AZIMUTHS])


def _write_colmap(folder: Path) -> None:
    entries = []
    for name in ("sparse/0", "images", "masks"):
        (folder / name).mkdir(parents=True)
    for azimuth in _AZIMUTHS:
        view, name = view_at(azimuth), f"{azimuth}.png"
        Image.fromarray(to_bytes(view.image.permute(1, 2, 0))).save(folder / "images" / name)
        Image.fromarray(to_bytes(view.mask)).save(folder / "masks" / name)
        entries.append(Entry(name, view.camera))
    write_binary(folder / "sparse" / "0", entries)


@pytest.mark.parametrize(
    ("write", "scene", "mask"),
    [
        (_write_transforms, "{}", "mask_000.png"),
        (_write_colmap, "{}", "masks/0.png"),
        (write_capture, "co3d:{}/cup/one", "cup/one/masks/frame000001.png"),
    ],
)
def test_an_edited_mask_is_noticed_from_every_folder(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    write: Callable[[Path], None],
    scene: str,
    mask: str,
) -> None:
    write(tmp_path / "cap")
    monkeypatch.chdir(tmp_path)
    here, there = (open_scene(scene.format(root)) for root in ("cap", tmp_path / "cap"))
    assert all(file.is_file() for frame in here.frames for file in frame.files)
    assert CaptureKeys.of(here) == CaptureKeys.of(there)
    before = frame_digest(here.frames[0])
    assert before == frame_digest(there.frames[0])
    with Image.open(tmp_path / "cap" / mask) as picture:
        edited = picture.point(lambda value: 255 - value)
    edited.save(tmp_path / "cap" / mask)
    assert frame_digest(here.frames[0]) != before
