"""Synthetic sequences on disk."""

import os
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from captures import write_capture

from data_prep.synthesize import CLOUD_POINTS, synthesize
from extrap_train.config import SyntheticConfig
from extrap_train.data.co3d import read_category
from extrap_train.data.synthetic import build_scene, handheld_orbit, render, walk_seed
from extrap_train.errors import InputError
from extrap_train.jobs.local import LocalLauncher
from extrap_train.store.atomic import partial_path

SMALL = SyntheticConfig(test_sequences=1, train_sequences=2, frames=3, image_size=16)


def contents(root: Path) -> dict[str, bytes]:
    return {str(p.relative_to(root)): p.read_bytes() for p in root.rglob("*") if p.is_file()}


def times(root: Path, name: str) -> dict[str, int]:
    return {p.name: p.stat().st_mtime_ns for p in (root / "apple" / name / "images").iterdir()}


@pytest.fixture(scope="module", autouse=True)
def _few_points() -> Iterator[None]:
    """The clouds take longer than pictures of this size."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("data_prep.synthesize.CLOUD_POINTS", 500)
        yield


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("synthetic")
    synthesize(SMALL, "apple", root, LocalLauncher(1))
    return root


@pytest.fixture
def root(made, tmp_path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "data"))


def test_the_reader_finds_what_was_rendered(made):
    sequences = read_category(made, "apple")
    assert [sequence.name for sequence in sequences] == ["0000", "0001", "0002"]
    scene = build_scene("apple", 1, SMALL.seed)
    cameras = handheld_orbit(scene, 3, 16, walk_seed("apple", 1, SMALL.seed))
    expected, view = render(scene, cameras[2]), sequences[1].frames[2].load()
    torch.testing.assert_close(view.camera.world_to_cam, expected.camera.world_to_cam)
    torch.testing.assert_close(view.camera.intrinsics, expected.camera.intrinsics)
    torch.testing.assert_close(view.depth, expected.depth, rtol=1e-3, atol=0)
    assert torch.equal(view.mask, expected.mask)
    assert (view.image - expected.image).abs().mean() < 0.03  # a JPEG
    assert sequences[1].point_cloud.find() is not None


def test_the_same_files_for_any_number_of_workers(tmp_path, monkeypatch):
    two = replace(SMALL, train_sequences=1, frames=2)
    with LocalLauncher(2) as launcher:
        synthesize(two, "apple", tmp_path / "two", launcher)
    monkeypatch.setattr("data_prep.synthesize.CLOUD_POINTS", CLOUD_POINTS)  # as those workers do
    synthesize(two, "apple", tmp_path / "one", LocalLauncher(1))
    assert contents(tmp_path / "two") == contents(tmp_path / "one")


def test_only_what_is_missing_is_rendered(root, made, capsys):
    before = times(root, "0000")
    shutil.rmtree(root / "apple" / "0001")
    synthesize(SMALL, "apple", root, LocalLauncher(1))
    assert times(root, "0000") == before
    assert contents(root) == contents(made)
    assert "2 of 3 sequences are there already" in capsys.readouterr().out


def test_what_a_killed_run_left_behind_is_made_anew(root, made):
    category = root / "apple"
    (category / "0002" / "synthetic.json").write_bytes(b'{"options": {"lo')
    shutil.rmtree(category / "0001")
    for file in ("synthetic_annotations.json", "frame_annotations.jgz"):
        (category / file).unlink()
    synthesize(SMALL, "apple", root, LocalLauncher(1))
    assert contents(root) == contents(made)


def test_a_run_that_was_killed_before_its_first_sequence_goes_on(tmp_path, made):
    (tmp_path / "apple" / ".0000.elsewhere-7.tmp" / "apple" / "0000").mkdir(parents=True)
    (tmp_path / "apple" / ".lock").touch()
    (tmp_path / "apple" / "0001").mkdir()
    synthesize(SMALL, "apple", tmp_path, LocalLauncher(1))
    shutil.rmtree(tmp_path / "apple" / ".0000.elsewhere-7.tmp")
    assert contents(tmp_path) == contents(made)


@pytest.mark.parametrize("names", [("106_12648_23157", "one"), ("0000", "0001")])
def test_a_download_is_left_as_it_is(tmp_path, names):
    write_capture(tmp_path, names, frames=1)
    before = contents(tmp_path)
    with pytest.raises(InputError, match=r"cup: is not a folder of synthetic.*data=co3d\?"):
        synthesize(SMALL, "cup", tmp_path, LocalLauncher(1))
    assert contents(tmp_path) == before


def test_a_folder_of_somebody_elses_is_left_as_it_is(root):
    shutil.rmtree(root / "apple" / "0001")
    (root / "apple" / "0001").mkdir()
    (root / "apple" / "0001" / "notes.txt").write_text("mine")
    before = contents(root)
    for config in (SMALL, replace(SMALL, frames=2)):
        with pytest.raises(InputError, match=r"holds 0001\) and is left as it is"):
            synthesize(config, "apple", root, LocalLauncher(1))
    assert contents(root) == before


def test_a_download_that_was_unpacked_over_synthetic_captures_is_left_as_it_is(root):
    write_capture(root, ("106_12648_23157",), frames=1)
    shutil.copytree(root / "cup", root / "apple", dirs_exist_ok=True)
    before = contents(root)
    with pytest.raises(InputError, match=r"holds sequence_annotations\.jgz"):
        synthesize(replace(SMALL, train_sequences=3), "apple", root, LocalLauncher(1))
    assert contents(root) == before


def test_a_sequence_that_lies_elsewhere_by_a_link_is_rendered_again_there(root, tmp_path):
    link, elsewhere = root / "apple" / "0001", tmp_path / "elsewhere"
    link.rename(elsewhere)
    link.symlink_to(elsewhere)
    synthesize(replace(SMALL, frames=2), "apple", root, LocalLauncher(1))
    assert link.readlink() == elsewhere
    assert len(list((elsewhere / "images").iterdir())) == 2


def test_half_of_a_rendering_is_removed_but_not_a_living_ones(root):
    half = partial_path(root / "apple" / "0000")
    (half / "apple" / "0000").mkdir(parents=True)
    living = half.with_name(half.name.replace(f"-{os.getpid()}.", f"-{os.getppid()}."))
    living.mkdir()
    synthesize(SMALL, "apple", root, LocalLauncher(1))
    assert [path.name for path in (root / "apple").glob(".*.tmp")] == [living.name]


def test_more_training_sequences_keep_the_test_sequences(root):
    before = times(root, "0000")
    synthesize(replace(SMALL, train_sequences=3), "apple", root, LocalLauncher(1))
    assert times(root, "0000") == before
    assert len(read_category(root, "apple")) == 4


def test_other_options_replace_the_sequences_and_say_so(root, capsys):
    synthesize(replace(SMALL, frames=2), "apple", root, LocalLauncher(1))
    assert "3 sequences were made with other options" in capsys.readouterr().out
    assert [len(sequence.frames) for sequence in read_category(root, "apple")] == [2, 2, 2]


def test_an_unknown_category_leaves_nothing_behind(tmp_path):
    with pytest.raises(InputError, match="no synthetic category"):
        synthesize(SMALL, "toaster", tmp_path, LocalLauncher(1))
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_one_line(tmp_path):
    (tmp_path / "apple").write_text("a file where a folder belongs")
    with pytest.raises(InputError, match="cannot be written"):
        synthesize(SMALL, "apple", tmp_path, LocalLauncher(1))
