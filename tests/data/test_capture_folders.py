"""Captures of one's own, `data=folders`: a folder per category, an entry per capture."""

import json
import shutil
from pathlib import Path

import pytest
from captures import view_at
from complaints import complaint_of
from PIL import Image
from posed_folders import write_transforms

from data_prep.category_pairs import prepare_category, prepare_members
from extrap_train.cli import PREP, TRAIN, compose_config
from extrap_train.config import (
    DatasetDepthConfig,
    FlowMatcherConfig,
    FoldersConfig,
    PrepConfig,
)
from extrap_train.data import scene_spec
from extrap_train.data.capture_folders import read_category, require_category
from extrap_train.data.scene_spec import open_scene
from extrap_train.errors import InputError


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Two captures of mugs, one of them zipped, and what is no capture."""
    for name in ("blue", "red"):
        write_transforms(tmp_path / "mug" / name, [view_at(30 * i) for i in range(12)])
    shutil.make_archive(str(tmp_path / "mug" / "red"), "zip", tmp_path / "mug" / "red")
    shutil.rmtree(tmp_path / "mug" / "red")
    (tmp_path / "mug" / "notes.txt").write_text("taken on Sunday")
    return tmp_path


@pytest.fixture(autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))


def _write_photographs(folder: Path) -> Path:
    folder.mkdir(parents=True)
    for name in "abc":
        Image.new("RGB", (16, 16)).save(folder / f"{name}.jpg")
    return folder


def test_every_entry_is_a_capture_of_the_category(root: Path) -> None:
    found = read_category(root, "mug")
    assert [(one.category, one.name, len(one.frames)) for one in found] == [
        ("mug", "blue", 12),
        ("mug", "red", 12),
    ]


def test_a_damaged_capture_is_left_out_with_a_warning(root: Path, caplog) -> None:
    (root / "mug" / "blue" / "transforms.json").write_text("{")
    assert [one.name for one in read_category(root, "mug")] == ["red"]
    assert str(root / "mug" / "blue") in caplog.text
    (root / "mug" / "red.zip").unlink()
    assert "transforms.json" in complaint_of(read_category, root, "mug")


def test_a_folder_of_the_wrong_level_is_named(root: Path) -> None:
    assert "the one above" in complaint_of(require_category, root / "mug", "mug")
    assert "folders there: mug" in complaint_of(require_category, root, "cup")
    _write_photographs(root / "cup")
    assert str(root / "cup" / "NAME") in complaint_of(require_category, root, "cup")


def test_depth_that_photographs_cannot_bring_is_refused_before_cameras_are_estimated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scene_spec, "read_unposed", lambda *_: pytest.fail("cameras estimated"))
    photographs = _write_photographs(tmp_path / "mug" / "one")
    said = complaint_of(lambda: open_scene(str(photographs), needs_depth=True))
    assert "depth=stereo" in said
    prepare = (FoldersConfig(root=str(tmp_path)), DatasetDepthConfig(), PrepConfig())
    assert "depth=stereo" in complaint_of(lambda: _prepare(tmp_path, *prepare))


@pytest.mark.parametrize("command", [TRAIN, PREP], ids=["train", "prep"])
def test_photographs_without_cameras_are_placed_by_the_chosen_matches(
    command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = []

    def place(*arguments):
        given.append(arguments[-1])
        raise InputError("not placed")

    monkeypatch.setattr(scene_spec, "read_unposed", place)
    _write_photographs(tmp_path / "apple" / "one")
    chosen = ["poses=aliked", "poses.checkpoint=a.pth", "depth=stereo", f"output={tmp_path}"]
    words = ["category=apple", "data=folders", f"data.root={tmp_path}", *chosen]
    with pytest.raises(InputError, match="not placed"):
        list(prepare_members(compose_config(command, words), workers=1))
    assert [(poses.name, poses.checkpoint) for poses in given] == [("aliked", "a.pth")]


def test_they_are_prepared_for_training_with_one_held_out(root: Path) -> None:
    prep = PrepConfig(image_size=32, correct=False)
    prepared = _prepare(root, FoldersConfig(root=str(root)), DatasetDepthConfig(), prep)
    assert sorted(prepared.roles) == ["mug/blue", "mug/red"]
    assert sorted(prepared.roles.values()) == ["test", "train"]


@pytest.mark.parametrize("key", ["depth_unit_scale_factor", "p1"])
def test_a_corrected_unit_of_depth_or_lens_is_prepared_again(root: Path, key: str, capsys) -> None:
    prep = PrepConfig(image_size=32, correct=False)
    options = (FoldersConfig(root=str(root)), DatasetDepthConfig(), prep)
    before = _prepare(root, *options)
    file = root / "mug" / "blue" / "transforms.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {key: 0.002}))
    after = _prepare(root, *options)
    assert before.manifest["key"] != after.manifest["key"]
    assert before.manifest["files"] != after.manifest["files"]
    capsys.readouterr()
    _prepare(root, *options)
    assert "prepared already" in capsys.readouterr().out


def _prepare(root, data, depth, prep):
    output, how = root / "outputs", FlowMatcherConfig()
    return prepare_category("mug", data, depth, prep, output=output, workers=1, matcher=how)
