"""Roots and outputs that cannot be used end with one line, and with nothing half-written."""

import errno
import gzip
import json
import os
import re
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from in_process import refused_command

from data_prep.__main__ import main as prepare
from extrap_train.__main__ import main


def test_a_missing_root_is_named_and_hydra_adds_no_line(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    options = ["category=hydrant", "data=co3d", f"data.root={tmp_path / 'nowhere'}"]
    assert "nowhere" in refused_command([*options, "model.start=null"], tmp_path)
    assert "Error executing job" not in capfd.readouterr().err


def test_a_run_is_not_begun_on_data_that_are_none(tmp_path: Path) -> None:
    """Else its name would be taken."""
    (tmp_path / "co3d").mkdir()
    options = ["category=hydrant", "data=co3d", f"data.root={tmp_path / 'co3d'}", "run=mine"]
    assert "has no category" in refused_command([*options, "model.start=null"], tmp_path)


@pytest.mark.parametrize("command", [main, prepare])
def test_no_member_is_prepared_where_another_is_missing(
    command: Callable[[], None], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The one that is there is not even read: its annotations would be refused."""
    (tmp_path / "co3d/apple").mkdir(parents=True)
    (tmp_path / "co3d/apple/frame_annotations.jgz").touch()
    options = ["category=all", "data=co3d", f"data.root={tmp_path / 'co3d'}"]
    start = ["model.start=null"] if command is main else []
    monkeypatch.setattr(sys, "argv", ["it", *options, *start, f"output={tmp_path / 'out'}"])
    with pytest.raises(SystemExit, match="has no category 'book'; categories present: apple"):
        command()
    assert not (tmp_path / "out").exists()


def test_a_run_is_not_removed_before_there_is_another(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "co3d").mkdir()
    run = tmp_path / "out/train/hydrant/small/mine"
    for name in ("summary.json", "checkpoints/step-00000003.ckpt", "model/unet"):
        (run / name).parent.mkdir(parents=True, exist_ok=True)
        (run / name).touch()
    before = sorted(run.rglob("*"))
    options = ["data=co3d", f"data.root={tmp_path / 'co3d'}", "run=mine", "model.start=null"]
    words = ["extrap_train", "category=hydrant", "resume=false", *options]
    monkeypatch.setattr(sys, "argv", [*words, f"output={tmp_path / 'out'}"])
    with pytest.raises(SystemExit, match="has no category"):
        main()
    assert sorted(run.rglob("*")) == before


def test_a_full_disk_anywhere_is_one_line(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("extrap_train.__main__.task", lambda name: full)
    assert "out: No space left on device" in refused_command(["category=hydrant"], tmp_path)


def test_a_name_that_is_too_long_is_one_line(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def run(*_: object) -> None:
        (tmp_path / "out" / ("x" * 300)).mkdir(parents=True)

    monkeypatch.setattr("extrap_train.__main__.task", lambda name: run)
    assert "shorter run=NAME" in refused_command(["category=hydrant"], tmp_path)


@pytest.mark.parametrize(
    ("place", "remedy"),
    [("out", "choose another output="), ("data/cup", "change its rights")],
)
def test_a_closed_place_is_called_what_it_is(
    place: str, remedy: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def closed(*_: object) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(tmp_path / place))

    monkeypatch.setattr("extrap_train.__main__.task", lambda name: closed)
    message = refused_command(["category=hydrant"], tmp_path)
    assert f"{place}: Permission denied; " in message
    assert remedy in message


def test_a_folder_above_the_output_that_cannot_be_made_is_of_the_output(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def closed(*_: object) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(tmp_path / "out"))

    monkeypatch.setattr("extrap_train.__main__.task", lambda name: closed)
    options = ["extrap_train", "category=hydrant", f"output={tmp_path / 'out' / 'deep' / 'down'}"]
    monkeypatch.setattr(sys, "argv", options)
    with pytest.raises(SystemExit, match=r"out: Permission denied; .* choose another output="):
        main()


def test_a_root_that_may_not_be_looked_at_is_one_line(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Even where that is found while the options are still checked."""

    def closed(*_: object) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), "/closed/co3d")

    monkeypatch.setattr("extrap_train.cli.validate", closed)
    options = ["category=hydrant", "data=co3d", "data.root=/closed/co3d"]
    message = refused_command(options, tmp_path)
    assert message.startswith("error: /closed/co3d: Permission denied; ")
    assert "change its rights" in message


@pytest.mark.parametrize("place", ["file", "/proc/nowhere"])
def test_an_output_that_can_be_no_folder_is_one_line(
    place: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("not a folder")
    output = tmp_path / place
    options = ["category=hydrant", "data.train_sequences=1", f"output={output}"]
    monkeypatch.setattr(sys, "argv", ["command", *options])
    with pytest.raises(SystemExit) as stopped:
        prepare()
    message = str(stopped.value)
    assert re.fullmatch(rf"error: {output}.*choose another (output=|folder)", message), message


def test_annotations_that_climb_out_are_refused(tmp_path: Path) -> None:
    folder = tmp_path / "co3d" / "hydrant"
    folder.mkdir(parents=True)
    viewpoint = {
        "R": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
        "T": [0, 0, 5],
        "focal_length": [2, 2],
        "principal_point": [0, 0],
        "intrinsics_format": "ndc_isotropic",
    }
    frame = {
        "sequence_name": "a",
        "frame_number": 0,
        "image": {"path": "../../secret.jpg", "size": [64, 64]},
        "viewpoint": viewpoint,
    }
    sequence = {"sequence_name": "a", "category": "hydrant"}
    for name, entries in (("frame", [frame]), ("sequence", [sequence])):
        content = gzip.compress(json.dumps(entries).encode())
        (folder / f"{name}_annotations.jgz").write_bytes(content)
    options = ["category=hydrant", "data=co3d", f"data.root={tmp_path / 'co3d'}"]
    message = refused_command([*options, "model.start=null"], tmp_path)
    assert "../../secret.jpg" in message
