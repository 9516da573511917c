"""One scene on the command line: adapt to it, look at it from a pose and from a walk around it."""

import json
import math
import re
import shutil
from pathlib import Path

import cv2
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from extrap_train import open_generator, open_views, walk_around
from extrap_train.config import LoraConfig, SyntheticConfig
from extrap_train.data.scene_spec import open_scene
from extrap_train.diffusion.generator import DiffusionGenerator
from extrap_train.diffusion.lora import AdapterOrigin, add_adapter, save_adapter
from extrap_train.diffusion.model_files import load_model, save_model
from extrap_train.figures import picture_names
from extrap_train.tasks.scene_inputs import frame_digest


def test_a_walk_around_the_scene_is_pictures_and_films(command, weights, tmp_path) -> None:
    command("task=view", f"weights={weights}", "orbit=120", "frames=3")
    folder = tmp_path / "view" / "hydrant-0000"
    for name in ("orbit", "orbit_warp"):
        assert Image.open(folder / f"{name}.gif").n_frames == 3
        film = cv2.VideoCapture(str(folder / f"{name}.mp4"))
        shapes = [film.read()[1].shape for _ in range(3)]
        assert shapes == [(128, 128, 3)] * 3
        assert not film.read()[0]
    assert Image.open(folder / "views" / "002.png").size == (16, 16)
    assert (folder / "views" / "002_warp.png").is_file()
    assert (folder / "sheet.png").is_file()


def test_a_frame_as_pose_has_its_photograph_beside_it(command, weights, tmp_path, capsys) -> None:
    command("task=view", f"weights={weights}", "pose=frame000003")
    folder = tmp_path / "view" / "hydrant-0000"
    assert (folder / "views" / "frame000003.png").is_file()
    assert Image.open(folder / "truth.png").size == (16, 16)
    assert "PSNR against the photograph" in capsys.readouterr().out


def test_the_photograph_that_is_asked_for_is_no_input(
    command, weights, tmp_path, capsys, monkeypatch
) -> None:
    """By default every frame is one, and the nearest to its own pose would be itself."""
    given = []
    generate = DiffusionGenerator.generate

    def recorded(self, references, queries, names, seed=0):
        given.append([view.name for view in references])
        return generate(self, references, queries, names, seed)

    monkeypatch.setattr(DiffusionGenerator, "generate", recorded)
    again = ["task=view", f"weights={weights}", "pose=frame000003", "resume=false"]
    for inputs, count in (("null", 7), ("7", 7)):
        command(*again, f"inputs={inputs}")
        assert len(given[-1]) == count
        assert "frame000003" not in given[-1]
        assert "PSNR against the photograph" in capsys.readouterr().out
    named = "input_frames=[frame000001,frame000003,frame000005]"
    command(*again, "inputs=null", named)
    assert "frame000003" in given[-1]
    said = capsys.readouterr().out
    assert "no PSNR: frame000003 is an input itself" in said
    assert "PSNR against" not in said


def test_the_same_in_three_lines_of_python(weights) -> None:
    generator = open_generator(str(weights), device="cpu", precision="32-true")
    views = open_views("synthetic:cup/0001", inputs=3, size=generator.warp_size)
    images = generator.generate(views, *walk_around(views, degrees=90.0, frames=2)).images
    assert images.shape == (2, 3, 16, 16)
    lower = open_generator(str(weights), device="cpu", precision="bf16-mixed")
    again = lower.generate(views, *walk_around(views, degrees=90.0, frames=2)).images
    assert again.dtype == images.dtype
    assert 0 < (again - images).abs().max() < 0.1


def _poses(path: Path, translation: float, *names: str) -> Path:
    """A camera of 512 pixels with a lens of its own, once or by several names."""
    matrix = torch.eye(4)
    matrix[2, 3] = translation
    entry = {"transform_matrix": matrix.tolist(), "w": 512, "h": 512, "fl_x": 300.0}
    named = [entry | {"file_path": name} for name in names]
    path.write_text(json.dumps({"frames": named or [entry]}))
    return path


def test_poses_come_from_a_file_with_any_lens(command, weights, tmp_path) -> None:
    poses = _poses(tmp_path / "poses.json", 4.0)
    command("task=view", f"weights={weights}", f"pose={poses}")
    assert (tmp_path / "view" / "hydrant-0000" / "views" / "000.png").is_file()


def test_how_much_the_inputs_show_is_said_and_where_it_is_nothing_what_to_look_for(
    command, weights, tmp_path, capsys
) -> None:
    """As of a camera whose file has other axes, or another unit."""
    view = ["task=view", f"weights={weights}"]
    command(*view, "pose=frame000003")
    said = capsys.readouterr()
    share = re.search(r"the inputs show (\d+) % of frame000003", said.out)
    assert share
    assert 5 < int(share[1]) <= 100
    assert "made up" not in said.err
    turned = torch.diag(torch.tensor([1.0, -1, -1, 1]))
    turned[2, 3] = 4.0
    far = torch.eye(4)
    far[2, 3] = 160.0
    for odd in (turned, far):
        poses = _poses(tmp_path / "poses.json", 4.0, "front", "odd")
        content = json.loads(poses.read_text())
        content["frames"][1]["transform_matrix"] = odd.tolist()
        poses.write_text(json.dumps(content))
        command(*view, f"pose={poses}")
        said = capsys.readouterr()
        assert re.search(r"the inputs show [01] to \d+ % of the views", said.out)
        assert "the inputs show next to nothing of odd, which is made up" in said.err
        assert "OpenGL" in said.err
        assert len(said.err.strip().splitlines()) == 1


def test_pictures_of_all_names_lie_beside_each_other_and_nothing_else_does(
    command, refused, weights, tmp_path
) -> None:
    """Neither what another pose left, nor one picture in the other's place."""
    folder = tmp_path / "view" / "hydrant-0000"
    command("task=view", f"weights={weights}", "pose=frame000003")
    assert (folder / "truth.png").is_file()
    names = ["left/0001.png", "right/0001.png", "img.1", "img.2", "./a", "a_warp", "A", "a"]
    poses = _poses(tmp_path / "poses.json", 4.0, *names)
    command("task=view", f"weights={weights}", f"pose={poses}")
    there = {path.name for path in folder.iterdir()}
    assert there == {"views", "sheet.png", "manifest.json", "summary.json"}
    assert len(list((folder / "views").iterdir())) == 2 * len(names)
    assert (folder / "views" / "left_0001.png").is_file()
    assert (folder / "views" / "img.2_warp.png").is_file()
    for odd in ("a\0b", "../a", "", "\ud800"):
        message = refused("task=view", f"weights={weights}", f"pose={_poses(poses, 4.0, odd)}")
        assert str(poses) in message


@given(st.lists(st.text(min_size=1), max_size=12))
def test_no_two_pictures_have_one_name(names: list[str]) -> None:
    stems = picture_names(names)
    files = [f"{stem}{end}.png".lower() for stem in stems for end in ("", "_warp")]
    assert len(set(files)) == 2 * len(names)
    assert not any("/" in file or len(file.encode()) > 255 for file in files)


@pytest.mark.usefixtures("measured_once")
def test_an_adapter_is_made_used_again_and_put_upon_the_weights(
    command, weights, tmp_path, capsys
) -> None:
    options = ["minutes=0.2", "lora.steps=4", "lora.validate_every=2", "lora.batch_size=2"]
    command("task=scene", f"weights={weights}", *options)
    folder = tmp_path / "scene" / "hydrant-0000"
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["pairs"] == {"all": 32, "trained": 28}
    assert summary["adaptation"]["steps"] == 4
    assert set(summary["held_out"]) == {"model", "adapted"}
    assert math.isfinite(summary["held_out"]["adapted"]["psnr"])
    assert (folder / "held_out.png").is_file()
    assert (folder / "curve.png").is_file()
    capsys.readouterr()
    command("task=scene", f"weights={weights}", *options)
    assert "already adapted with these options" in capsys.readouterr().out
    view = ["task=view", f"weights={weights}", f"adapter={folder / 'adapter'}"]
    learnt, other = (names[0] for names in (summary["inputs"], summary["held_out_frames"]))
    command(*view, f"pose={other}")
    said = capsys.readouterr()
    assert "PSNR against the photograph" in said.out
    assert "was made for" not in said.err
    command(*view, f"pose={learnt}")
    assert f"no PSNR: the adapter was trained on {learnt}" in capsys.readouterr().out
    command(*view, f"pose={other}", "scene=synthetic:cup/0001")
    said = capsys.readouterr()
    assert "was made for synthetic:hydrant/0000, not for synthetic:cup/0001" in said.err
    assert "PSNR against the photograph" in said.out


def test_a_damaged_adapter_is_made_again_and_one_of_other_weights_is_kept(
    command, refused, weights, brief, tmp_path, capsys
) -> None:
    """Weights of the same name that were trained for longer are other weights."""
    folder, model = tmp_path / "scene" / "hydrant-0000", tmp_path / "model"
    shutil.copytree(weights, model)
    asked = ["task=scene", f"weights={model}", *brief]

    def is_made() -> bool:
        capsys.readouterr()
        command(*asked)
        return "already adapted" not in capsys.readouterr().out

    assert is_made()
    assert not is_made()
    shutil.rmtree(folder / "adapter")
    assert is_made()
    (folder / "summary.json").write_text('{"adaptation": {"steps": "many"}}')
    assert is_made()
    trained_on = load_model(model)
    torch.nn.init.normal_(trained_on.unet.conv_out.weight, std=0.05)
    save_model(trained_on, model)
    assert "made with different weights (other content)" in refused(*asked)
    assert "was trained on other weights" in refused(
        "task=view", f"weights={model}", f"adapter={folder / 'adapter'}", "pose=frame000003"
    )


def test_before_a_run_the_category_s_packaged_model_generates_and_says_so(
    command, tmp_path, capsys
) -> None:
    command("task=view", "pose=frame000003")
    assert "generated with ours-hydrant (packaged, 1,200 steps)" in capsys.readouterr().out
    summary = json.loads((tmp_path / "view" / "hydrant-0000" / "summary.json").read_text())
    assert summary["generated_with"]["name"] == "ours-hydrant"
    assert len(summary["generated_with"]["sha256"]) == 64
    assert len(summary["photographs"]) == 4
    assert Image.open(tmp_path / "view" / "hydrant-0000" / "truth.png").size == (64, 64)


def test_what_cannot_be_used_is_one_line(refused, weights, tmp_path) -> None:
    given = f"weights={weights}"
    one = ["task=scene", given, "inputs=1"]
    assert "has 1 input view, and pairs need at least two" in refused(*one)
    assert "give scene=FOLDER" in refused("task=scene", given, "scene=null")
    another = refused("task=scene", "model.name=mine")
    assert "there is no trained model of hydrant; train one (task=category)" in another
    assert "nor one of the package's: base, megascenes, ours-apple" in refused(
        "task=scene", "weights=bse"
    )
    lone = ["task=scene", given, "lora.virtual_references=1"]
    assert "lora.virtual_references=1" in refused(*lone)
    view = ["task=view", given]
    assert "a pose=FRAME|FILE.json or an orbit=DEGREES" in refused(*view)
    unknown = refused(*view, "pose=frame00003")
    assert "neither a frame of the scene nor a .json file; did you mean frame000003" in unknown
    assert "an orbit needs 3 input views" in refused(*view, "orbit=90", "inputs=2")
    broken = _poses(tmp_path / "nan.json", math.nan)
    assert "camera of 000 is degenerate (NaN" in refused(*view, f"pose={broken}")
    empty = tmp_path / "empty.json"
    empty.write_text('{"frames": []}')
    assert "expected frames in a list" in refused(*view, f"pose={empty}")
    assert "has 8 frames, fewer than the 9" in refused(*view, "orbit=90", "inputs=9")


def _adapter_of(weights: Path, folder: Path, *frames: str) -> Path:
    """An adapter without effect that says it was trained on these."""
    model = load_model(weights)
    adapter = add_adapter(model, LoraConfig(rank=1), seed=0)
    options = SyntheticConfig(frames=8, image_size=32)
    known = {frame.name: frame for frame in open_scene("synthetic:hydrant/0000", options).frames}
    learnt = {name: frame_digest(known[name]) for name in frames}
    origin = AdapterOrigin("synthetic:hydrant/0000", learnt, str(weights))
    save_adapter(model, adapter, folder, origin)
    return folder


def test_no_held_out_view_is_generated_from_where_it_stands_nor_by_who_has_learnt_it(
    command, weights, tmp_path, monkeypatch
) -> None:
    """Completed at the capture's own poses, the map has a view where each photograph was taken."""
    asked = []
    generate = DiffusionGenerator.generate

    def recorded(self, references, queries, names, seed=0):
        asked.append((names[0], [view.name for view in references]))
        return generate(self, references, queries, names, seed)

    monkeypatch.setattr(DiffusionGenerator, "generate", recorded)
    adapter = _adapter_of(weights, tmp_path / "adapter", "frame000001", "frame000005")
    options = ["complete.poses=capture", "complete.splats.fit=false", "sampler.steps=1"]
    options += ["complete.confidence.attempts=1", "complete.symmetry=false", f"adapter={adapter}"]
    inputs = ",".join(f"frame00000{index}" for index in range(4))
    options += ["inputs=null", f"input_frames=[{inputs}]"]
    command("task=complete", f"weights={weights}", *options)
    summary = json.loads((tmp_path / "complete" / "hydrant_0000" / "summary.json").read_text())
    assert summary["views"]["generated"] == 4
    assert summary["held_out"]["views"] == 3
    assert len(asked) == 7
    assert "frame000005" not in [name for name, _ in asked[4:]]
    assert not [name for name, references in asked if name in references]
