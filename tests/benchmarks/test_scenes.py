"""A prepared draw gives a method its inputs and nothing else, and notices changed files."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.protocol.captures import Capture
from benchmarks.protocol.draws import Draw, draw_sequence
from benchmarks.protocol.prepared_scene import Scene, truths_removed
from benchmarks.protocol.scene_writing import prepare_scene
from extrap_train.config import DatasetDepthConfig, OwnDepthConfig, RulesConfig
from extrap_train.errors import InputError
from extrap_train.metrics import psnr
from tests.benchmarks.analytic import analytic_capture

_RULES = RulesConfig(image_size=32, pool=9)


def _prepare(folder: Path, capture: Capture, draw: Draw, rules: RulesConfig, origin: str) -> Scene:
    return prepare_scene(folder, capture, draw, rules, DatasetDepthConfig(), origin)


@pytest.fixture(scope="module")
def draw_and_scene(tmp_path_factory: pytest.TempPathFactory) -> tuple[Draw, Scene]:
    capture = Capture(analytic_capture(size=64))
    draw = draw_sequence("apple", "one", *_frames(capture.sequence), _RULES)[0]
    folder = tmp_path_factory.mktemp("table") / "scenes" / draw.label
    return draw, _prepare(folder, capture, draw, _RULES, "origin")


def _frames(capture):
    from extrap_train.views import stack_poses

    return [f.name for f in capture.frames], stack_poses([f.camera for f in capture.frames])


def test_inputs_are_the_photographs_with_depth(draw_and_scene: tuple[Draw, Scene]) -> None:
    draw, scene = draw_and_scene
    inputs = scene.inputs()
    frames = {frame.name: frame.load() for frame in analytic_capture(size=64).frames}
    for size, views in ((32, inputs.views), (64, inputs.fine_views)):
        assert [view.name for view in views] == list(draw.inputs)
        for view in views:
            true = frames[view.name].resized(size, size)
            torch.testing.assert_close(view.image, true.image, atol=0.5 / 255 + 1e-6, rtol=0)
            torch.testing.assert_close(view.depth, true.depth)
            torch.testing.assert_close(view.camera.world_to_cam, true.camera.world_to_cam)
            torch.testing.assert_close(view.camera.intrinsics, true.camera.intrinsics)
    assert inputs.targets.world_to_cam.shape == (6, 4, 4)


def test_only_an_oracle_is_given_the_data_sets_depth(tmp_path: Path) -> None:
    """A source of one's own that reads the views' depth finds none."""
    capture = Capture(analytic_capture(size=32))
    draw = draw_sequence("apple", "one", *_frames(capture.sequence), _RULES)[0]
    config = OwnDepthConfig(name="peek", factory="extrap_train.depth.DatasetDepth")
    with pytest.raises(InputError, match="depth"):
        prepare_scene(tmp_path / "scenes" / "draw", capture, draw, _RULES, config, "origin")


def test_a_method_needs_no_file_of_the_truth(draw_and_scene: tuple[Draw, Scene]) -> None:
    """With the truth out of reach the inputs are still complete, and afterwards it is as it was."""
    _, scene = draw_and_scene
    files = {file: file.read_bytes() for file in scene.truth_folder.rglob("*.*")}
    with truths_removed(scene.truth_folder.parent):
        assert not scene.truth_folder.exists()
        inputs = scene.inputs()
        contents = {f.read_bytes() for f in scene.folder.parents[1].rglob("*") if f.is_file()}
        assert not contents & set(files.values())
    assert {file: file.read_bytes() for file in scene.truth_folder.rglob("*.*")} == files
    known = {name for view in inputs.views for name in [view.name]}
    assert not known & set(scene.draw.targets)


def test_the_mask_is_what_the_inputs_show(draw_and_scene: tuple[Draw, Scene]) -> None:
    truth = draw_and_scene[1].truth()
    share = truth.masks.mean((1, 2))
    assert share.max() > 0.3
    assert share.max() < 1
    near = torch.tensor(draw_and_scene[1].record.angles_rad) < 1
    assert (psnr(truth.warps, truth.images, truth.masks)[near] > 22).all()
    assert not (truth.warps * (1 - truth.masks)[:, None]).any()


def test_what_is_there_is_used_and_what_was_touched_made_anew(
    draw_and_scene: tuple[Draw, Scene],
) -> None:
    draw, scene = draw_and_scene
    capture, folder = Capture(analytic_capture(size=64)), scene.folder
    before = (folder / "scene.json").stat().st_ino
    assert _prepare(folder, capture, draw, _RULES, "origin").data_hash == scene.data_hash
    assert (folder / "scene.json").stat().st_ino == before
    np.save(folder / "inputs" / "depth.npy", np.zeros((3, 64, 64), np.float32))
    assert scene.changed_files() == ["inputs/depth.npy"]
    again = _prepare(folder, capture, draw, _RULES, "origin")
    assert again.data_hash == scene.data_hash
    assert not again.changed_files()
    assert _prepare(folder, capture, draw, _RULES, "other").record.origin == "other"


@pytest.mark.parametrize("damaged", ['{"form', '{"format": 2}', "[]"])
def test_a_damaged_record_is_no_scene_and_made_anew(
    draw_and_scene: tuple[Draw, Scene], damaged: str
) -> None:
    draw, scene = draw_and_scene
    (scene.folder / "scene.json").write_text(damaged)
    again = _prepare(scene.folder, Capture(analytic_capture(size=64)), draw, _RULES, "origin")
    assert again.data_hash == scene.data_hash


def test_a_frame_that_the_capture_lacks_is_named(tmp_path: Path) -> None:
    draw = Draw("apple", "one", 1, "random", 0, ("nowhere.png",), ("000.png",))
    with pytest.raises(InputError, match=r"has no frame nowhere\.png"):
        _prepare(tmp_path / "scenes" / "one", Capture(analytic_capture()), draw, _RULES, "")
    assert not list(tmp_path.iterdir())


def test_estimated_depth_is_charged_to_the_method_that_asks() -> None:
    from benchmarks.protocol.prepared_scene import RecordedDepth

    source = RecordedDepth(7.5)
    assert source.seconds == 0
    source.depth_maps([frame.load() for frame in analytic_capture().frames[:2]])
    assert source.seconds == 7.5


def test_small_photographs_are_not_scaled_up(
    draw_and_scene: tuple[Draw, Scene], tmp_path: Path
) -> None:
    draw = draw_and_scene[0]
    small = Capture(analytic_capture(size=32))
    inputs = _prepare(tmp_path / "scenes" / "small", small, draw, _RULES, "").inputs()
    for fine, view in zip(inputs.fine_views, inputs.views, strict=True):
        assert torch.equal(fine.image, view.image)


def test_masks_of_the_finer_copy_hold_what_the_coarse_ones_reach(
    draw_and_scene: tuple[Draw, Scene], tmp_path: Path
) -> None:
    """A surface that a coarse warp reaches is reached by a finer one; not the other way round."""
    draw, scene = draw_and_scene
    capture, coarse = Capture(analytic_capture(size=64)), replace(_RULES, fine_scale=1)
    before = _prepare(tmp_path / "scenes" / "coarse", capture, draw, coarse, "").truth().masks
    now = scene.truth().masks
    assert (now >= before).float().mean() > 0.99
    assert now.mean() > before.mean()
