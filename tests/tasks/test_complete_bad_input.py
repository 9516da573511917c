"""What nobody can complete ends `task=complete` with one line, before anything is generated."""

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scenes
import torch
from PIL import Image

from extrap_train.__main__ import main
from extrap_train.data.image_files import to_eight_bits
from extrap_train.geometry.foreign_cameras import opengl_from_world_to_cam
from extrap_train.views import Camera

_SIZE = 256
_POSES = [(-15, 0.0), (0, 25.0), (12, 5.0), (25, -10.0)]


def _blocks(camera: Camera) -> np.ndarray:
    """The picture of a plane of random grey blocks, full of corners to match."""
    origins, directions = scenes.rays(camera)
    points = origins + directions * scenes.PLANE.hit(origins, directions)[:, None]
    cell = (points * 12).floor().long()
    grey = ((cell[:, 0] * 73856093) ^ (cell[:, 1] * 19349663)).remainder(97) / 97
    return to_eight_bits(grey.float().reshape(1, _SIZE, _SIZE).expand(3, -1, -1)).transpose(1, 2, 0)


@pytest.fixture(scope="module")
def pictures() -> list[np.ndarray]:
    return [_blocks(camera) for camera in _cameras()]


def _cameras() -> list[Camera]:
    return [scenes.orbit_camera(a, elevation_deg=e, size=_SIZE) for a, e in _POSES]


def _capture(folder: Path, pictures: list[np.ndarray], scale: float = 1.0) -> dict[str, Any]:
    """The content of a `transforms.json` whose pictures lie beside it."""
    folder.mkdir()
    frames = []
    for index, (camera, picture) in enumerate(zip(_cameras(), pictures, strict=True)):
        Image.fromarray(picture).save(folder / f"{index}.png")
        pose = opengl_from_world_to_cam(camera.world_to_cam.double())
        pose[:3, 3] *= scale
        frames.append({"file_path": f"{index}.png", "transform_matrix": pose.tolist()})
    k = _cameras()[0].intrinsics
    lens = {"fl_x": float(k[0, 0]), "fl_y": float(k[1, 1]), "cx": _SIZE / 2, "cy": _SIZE / 2}
    return {"w": _SIZE, "h": _SIZE, **lens, "frames": frames}


Command = Callable[..., str]


@pytest.fixture
def refused(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Command:
    """Run the command on a capture and give back the one line with which it ends."""

    def run(content: dict[str, Any], *arguments: str) -> str:
        folder = tmp_path / "scene"
        (folder / "transforms.json").write_text(json.dumps(content))
        options = ["task=complete", "category=book", f"scene={folder}", "weights=base"]
        options += ["depth=stereo", f"output={tmp_path / 'out'}", "complete.draw=spread"]
        monkeypatch.setattr(sys, "argv", ["extrap_train", *options, *arguments])
        with pytest.raises(SystemExit) as stopped:
            main()
        message = str(stopped.value)
        assert message.startswith("error: ")
        assert "\n" not in message
        assert not list((tmp_path / "out").rglob("*.safetensors"))
        return message

    return run


def test_a_single_view(refused: Command, pictures: list[np.ndarray], tmp_path: Path) -> None:
    content = _capture(tmp_path / "scene", pictures)
    assert "at least two" in refused(content, "inputs=1")


@pytest.mark.parametrize("one", ["inputs=1", "input_frames=[a.png]"])
def test_a_single_view_is_refused_before_the_scene_is_read(
    one: str, refused: Command, tmp_path: Path
) -> None:
    (tmp_path / "scene").mkdir()
    assert "at least two" in refused({"no": "cameras"}, one)


@pytest.mark.parametrize("task", ["complete", "view", "scene"])
@pytest.mark.parametrize(
    ("depth", "said"),
    [
        (["depth=mast3r", "depth.checkpoint=gone.pth"], "gone.pth"),
        (["depth=files", "depth.folder={scene}"], "holds no depth map"),
        (["depth=stereo", "inputs=1"], "at least two"),
    ],
)
def test_depth_that_cannot_be_had_is_refused_before_the_scene_is_read(
    task: str, depth: list[str], said: str, refused: Command, tmp_path: Path
) -> None:
    (tmp_path / "scene").mkdir()
    words = [word.format(scene=tmp_path / "scene") for word in depth]
    orbit = ["orbit=90"] if task == "view" else []
    assert said in refused({"no": "cameras"}, f"task={task}", *orbit, *words)


@pytest.mark.parametrize("task", ["complete", "view", "scene", "category"])
@pytest.mark.parametrize("inputs", [1, 2, 3])
def test_a_number_beside_names_is_refused(
    task: str, inputs: int, refused: Command, tmp_path: Path
) -> None:
    (tmp_path / "scene").mkdir()
    both = [f"task={task}", f"inputs={inputs}", "input_frames=[a.png,b.png]"]
    assert f"inputs={inputs} and input_frames (2 frames)" in refused({"no": "cameras"}, *both)


def test_a_scene_of_another_category_needs_a_named_model(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["task=complete", "category=cup", "scene=synthetic:hydrant/0000", "inputs=3"]
    options += [f"output={tmp_path}", "data.image_size=32", "complete.exact_size=32"]
    monkeypatch.setattr(sys, "argv", ["extrap_train", *options])
    with pytest.raises(SystemExit, match=r"is of category hydrant.*give category=hydrant"):
        main()
    more = ["complete.generator=exact", "complete.dry_run=true"]
    monkeypatch.setattr(sys, "argv", ["extrap_train", *options, *more])
    main()
    assert "the scene is of category hydrant, not cup" in capsys.readouterr().out


def test_two_identical_poses(refused: Command, pictures: list[np.ndarray], tmp_path: Path) -> None:
    content = _capture(tmp_path / "scene", pictures)
    content["frames"][1]["transform_matrix"] = content["frames"][0]["transform_matrix"]
    assert "stand in the same place" in refused(content, "inputs=4")


def test_views_that_see_nothing_in_common(
    refused: Command, pictures: list[np.ndarray], tmp_path: Path
) -> None:
    content = _capture(tmp_path / "scene", pictures)
    pose = torch.tensor(content["frames"][1]["transform_matrix"])
    pose[:3, :3] = pose[:3, :3] @ torch.diag(torch.tensor([-1.0, 1.0, -1.0]))
    content["frames"][1]["transform_matrix"] = pose.tolist()
    assert "see nothing in common" in refused(content, "inputs=4")


def test_a_wrong_axis_convention(
    refused: Command, pictures: list[np.ndarray], tmp_path: Path
) -> None:
    """OpenCV's poses in a file whose poses are OpenGL's: found by reprojection and named."""
    content = _capture(tmp_path / "scene", pictures)
    for frame, camera in zip(content["frames"], _cameras(), strict=True):
        frame["transform_matrix"] = camera.cam_to_world.double().tolist()
    assert "axes" in refused(content, "inputs=4")


def test_intrinsics_of_another_size(
    refused: Command, pictures: list[np.ndarray], tmp_path: Path
) -> None:
    content = _capture(tmp_path / "scene", pictures) | {"cx": _SIZE * 2.0, "fl_x": _SIZE * 9.0}
    assert "intrinsics" in refused(content, "inputs=4")


@pytest.mark.parametrize("scale", [1e-4, 1e4])
def test_the_unit_of_the_world_does_not_matter(
    scale: float,
    pictures: list[np.ndarray],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    content = _capture(tmp_path / "scene", pictures, scale)
    (tmp_path / "scene" / "transforms.json").write_text(json.dumps(content))
    options = ["task=complete", "category=book", f"scene={tmp_path / 'scene'}", "weights=base"]
    options += ["depth=stereo", "depth.image_size=96", "depth.planes=16", "inputs=4"]
    options += ["complete.dry_run=true", f"output={tmp_path}"]
    monkeypatch.setattr(sys, "argv", ["extrap_train", *options])
    main()
    assert "nothing was generated" in capsys.readouterr().out
