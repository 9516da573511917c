"""A result about a scene is its own: nothing else takes its place unasked, nor a part of it."""

import json
import shutil
from pathlib import Path

import pytest
import torch
from captures import write_capture
from filelock import FileLock

from extrap_train.diffusion.model_files import load_model, save_model
from extrap_train.tasks import scene


def _rank(folder: Path) -> int:
    return json.loads((folder / "adapter" / "adapter_config.json").read_text())["r"]


def test_an_interrupted_adaptation_leaves_what_was_there(
    command, weights, brief, tmp_path, capsys, monkeypatch
) -> None:
    """Though it was at its very end."""

    def stopped(*_: object) -> None:
        raise KeyboardInterrupt

    folder = tmp_path / "scene" / "hydrant-0000"
    command("task=scene", f"weights={weights}", *brief, "lora.rank=3")
    with monkeypatch.context() as patch:
        patch.setattr(scene, "_write", stopped)
        with pytest.raises(SystemExit) as ended:
            command("task=scene", f"weights={weights}", *brief, "lora.rank=2", "resume=false")
    assert str(ended.value).startswith("interrupted: nothing was changed")
    assert _rank(folder) == 3
    capsys.readouterr()
    command("task=scene", f"weights={weights}", *brief, "lora.rank=3")
    assert "already adapted with these options" in capsys.readouterr().out
    assert not list(folder.parent.glob(".*.tmp"))


def test_other_options_do_not_overwrite_an_adapter(
    command, refused, weights, brief, tmp_path
) -> None:
    base = ["task=scene", f"weights={weights}", *brief, "lora.rank=3"]
    command(*base)
    said = refused(*base, "lora.rank=2", "inputs=3")
    assert "scene/hydrant-0000: made with different " in said
    assert "inputs (was 4, now 3)" in said
    assert "lora.rank (was 3, now 2)" in said
    assert "run=NAME" in said
    assert "resume=false" in said
    assert "data.seed (was 0, now 5)" in refused(*base, "data.seed=5")
    command(*base, "lora.rank=2", "run=second")
    assert _rank(tmp_path / "scene" / "hydrant-0000") == 3
    assert _rank(tmp_path / "scene" / "second") == 2
    command(*base, "lora.rank=2", "resume=false")
    assert _rank(tmp_path / "scene" / "hydrant-0000") == 2
    assert "must be the name of a folder" in refused(*base, "run=../mine")


def test_two_scenes_of_one_name_do_not_overwrite_each_other(
    command, refused, weights, tmp_path
) -> None:
    for root in ("a", "b"):
        write_capture(tmp_path / root, names=("one",))
    one, other = (f"co3d:{tmp_path / root / 'cup' / 'one'}" for root in ("a", "b"))
    view = ["task=view", f"weights={weights}", "inputs=2"]
    command(*view, f"scene={one}", "pose=frame000001.jpg")
    same = f"co3d:{tmp_path / 'b' / '..' / 'a' / 'cup' / 'one'}"
    command(*view, f"scene={same}", "pose=frame000011.jpg")
    said = refused(*view, f"scene={other}", "pose=frame000001.jpg")
    assert f"scene (was {one}, now {other})" in said
    command(*view, f"scene={other}", "pose=frame000001.jpg", "run=b")
    assert (tmp_path / "view" / "b" / "views" / "frame000001.png").is_file()
    assert (tmp_path / "view" / "cup-one" / "views" / "frame000011.png").is_file()


def test_another_pose_replaces_a_view_but_other_weights_do_not(
    command, refused, weights, tmp_path
) -> None:
    """The same weights elsewhere are the same weights; others at the same place are not."""
    copy = Path(shutil.copytree(weights, tmp_path / "other"))
    command("task=view", f"weights={weights}", "pose=frame000003")
    command("task=view", f"weights={copy}", "pose=frame000005")
    model = load_model(copy)
    torch.nn.init.normal_(model.unet.conv_out.weight, std=0.06)
    save_model(model, copy)
    said = refused("task=view", f"weights={copy}", "pose=frame000005")
    assert "view/hydrant-0000: made with different weights (other content)" in said
    command("task=view", f"weights={copy}", "pose=frame000005", "resume=false")


def test_a_folder_that_says_not_what_it_is_of_is_left_alone(
    refused, weights, brief, tmp_path
) -> None:
    for task in (["task=view", "pose=frame000003"], ["task=scene", *brief], ["task=complete"]):
        mine = tmp_path / task[0].removeprefix("task=") / "mine"
        mine.mkdir(parents=True)
        (mine / "thesis.txt").write_text("years of work")
        for resume in ("true", "false"):
            said = refused(*task, f"weights={weights}", "run=mine", f"resume={resume}")
            assert "mine/manifest.json: cannot be read" in said
            assert "another run=" in said
            assert [path.name for path in mine.iterdir()] == ["thesis.txt"]


def test_a_link_to_a_folder_elsewhere_takes_the_result_there(command, weights, tmp_path) -> None:
    elsewhere, link = tmp_path / "disk" / "walks", tmp_path / "view" / "mine"
    elsewhere.mkdir(parents=True)
    link.parent.mkdir()
    link.symlink_to(elsewhere)
    for pose in ("frame000003", "frame000005"):
        command("task=view", f"weights={weights}", "run=mine", f"pose={pose}")
        assert link.is_symlink()
        assert (elsewhere / "views" / f"{pose}.png").is_file()


@pytest.mark.parametrize("task", [["task=scene"], ["task=view", "pose=frame000003"]])
def test_two_at_once_do_not_write_the_same_folder(refused, weights, tmp_path, task) -> None:
    lock = tmp_path / task[0].removeprefix("task=") / ".hydrant-0000.lock"
    lock.parent.mkdir()
    with FileLock(lock):
        said = refused(*task, f"weights={weights}")
    assert "another process is writing this result; wait for it or give run=NAME" in said


def test_what_is_asked_for_is_checked_before_depth_is_estimated(
    refused, weights, tmp_path, monkeypatch
) -> None:
    def estimated(*_: object, **__: object) -> None:
        raise AssertionError("depth was estimated for a pose that there is not")

    monkeypatch.setattr("extrap_train.tasks.scene_inputs.input_views", estimated)
    view = ["task=view", f"weights={weights}"]
    assert "did you mean frame000003" in refused(*view, "pose=frame00003")
    assert "an orbit needs 3 input views" in refused(*view, "orbit=90", "inputs=2")
    assert "no such file" in refused(*view, f"pose={tmp_path / 'gone.json'}")
