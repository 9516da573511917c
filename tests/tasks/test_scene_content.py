"""A result is known by the content it was made from: photographs, lenses, depth, weights."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from extrap_train.data.scene_spec import open_scene
from extrap_train.tasks.scene_inputs import photograph_digests

_NAMES = ["0.png", "1.png", "2.png"]


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """Three photographs with masks and depth around an object."""
    folder = tmp_path / "capture"
    folder.mkdir()
    rng = np.random.default_rng(0)
    frames = []
    for index, name in enumerate(_NAMES):
        Image.fromarray(rng.integers(0, 256, (16, 16, 3), np.uint8)).save(folder / name)
        depth = rng.integers(1000, 5000, (16, 16)).astype(np.uint16)
        Image.fromarray(depth).save(folder / f"depth{index}.png")
        Image.fromarray(rng.integers(0, 2, (16, 16), np.uint8) * 255).save(folder / f"m{index}.png")
        angle = 0.4 * index
        pose = np.eye(4)
        pose[:3, :3] = [
            [np.cos(angle), 0, np.sin(angle)],
            [0, 1, 0],
            [-np.sin(angle), 0, np.cos(angle)],
        ]
        pose[:3, 3] = 2 * pose[:3, 2]
        entry = {"file_path": name, "transform_matrix": pose.tolist()}
        frames.append(
            entry | {"depth_file_path": f"depth{index}.png", "mask_path": f"m{index}.png"}
        )
    lens = {"w": 16, "h": 16, "fl_x": 20.0, "fl_y": 20.0, "cx": 8.0, "cy": 8.0}
    (folder / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    return folder


def _digests(folder: Path) -> dict[str, str]:
    return photograph_digests(open_scene(str(folder)).frames)


def _edited(folder: Path, edit: Callable[[dict[str, Any]], None]) -> None:
    file = folder / "transforms.json"
    content = json.loads(file.read_text())
    edit(content)
    file.write_text(json.dumps(content))


def _inverted(path: Path) -> None:
    Image.fromarray(255 - np.asarray(Image.open(path))).save(path)


_EDITS: dict[str, Callable[[dict[str, Any]], None]] = {
    "focal length": lambda c: c.update(fl_x=40.0, fl_y=40.0),
    "principal point": lambda c: c.update(cx=8.5),
    "distortion": lambda c: c.update(k1=0.01),
    "tangential distortion": lambda c: c.update(p2=0.01),
    "unit of depth": lambda c: c.update(depth_unit_scale_factor=0.002),
    "pose": lambda c: [f["transform_matrix"][1].__setitem__(3, 0.1) for f in c["frames"]],
    "other depth": lambda c: [f.update(depth_file_path="depth0.png") for f in c["frames"][1:]],
    "no mask": lambda c: [f.pop("mask_path") for f in c["frames"]],
}


@pytest.mark.parametrize("what", list(_EDITS))
def test_another_description_is_other_content(capture: Path, what: str) -> None:
    before = _digests(capture)
    _edited(capture, _EDITS[what])
    after = _digests(capture)
    assert before.keys() == after.keys()
    assert sum(before[name] != after[name] for name in before) >= 2


@pytest.mark.parametrize("file", ["1.png", "m1.png"])
def test_another_file_is_other_content_of_its_frame_alone(capture: Path, file: str) -> None:
    before = _digests(capture)
    _inverted(capture / file)
    after = _digests(capture)
    assert [name for name in _NAMES if before[name] != after[name]] == ["1.png"]


def test_a_copy_elsewhere_is_the_same_content(capture: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(capture, tmp_path / "somewhere" / "else"))
    assert _digests(copy) == _digests(capture)


_TASKS = [
    ["task=complete", "complete.dry_run=true"],
    ["task=view", "pose=frame000003"],
]


@pytest.mark.parametrize("task", _TASKS)
def test_a_result_is_refused_where_anything_it_follows_from_is_another(
    command, refused, weights, tmp_path, task
) -> None:
    base = [*task, f"weights={weights}"]
    command(*base)
    for option, said in (
        ("trainer.precision=bf16-mixed", "trainer.precision (was 32-true, now bf16-mixed)"),
        ("seed=3", "seed (was 0, now 3)"),
        ("sampler.steps=1", "sampler.steps (was None, now 1)"),
        ("weights=ours-hydrant", "weights (other content)"),
    ):
        assert said in refused(*base, option)
    command(*base)
