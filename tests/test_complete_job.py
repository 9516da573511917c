"""`task=complete` on a tiny synthetic scene: what it leaves, that no kill changes it, bad input."""

import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from in_process import run_command
from plyfile import PlyData

from extrap_train.__main__ import main
from extrap_train.data.scene_spec import open_scene
from extrap_train.gaussians.ply import read_splats
from extrap_train.gaussians.rasterize import draw, rasterizer
from extrap_train.metrics import psnr

_TINY = [
    "task=complete",
    "category=cup",
    "scene=synthetic:cup/0000",
    "data.image_size=48",
    "inputs=3",
    "complete.generator=exact",
    "complete.exact_size=40",
    "complete.step_deg=60",
    "complete.splats.iterations=100",
    "complete.splats.count=2000",
    "threads=1",
]


def _start(output: Path) -> "subprocess.Popen[bytes]":
    command = [sys.executable, "-m", "extrap_train", *_TINY, f"output={output}"]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    output.mkdir(parents=True, exist_ok=True)
    with (output / "log.txt").open("wb") as log:
        return subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, env=environment)


def _finish(output: Path, *more: str, status: int = 0) -> str:
    return run_command(main, *_TINY, f"output={output}", *more, status=status)


@pytest.fixture(autouse=True, scope="module")
def _rendered_once(rendered_once: None, coarse_results: None) -> None:
    """See both."""


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("undisturbed")
    _finish(output)
    return output


def _folder(output: Path) -> Path:
    return output / "complete" / "cup_0000"


def _content(output: Path) -> dict[str, str]:
    folder = _folder(output)
    files = [folder / "cloud.ply", folder / "transforms.json", *sorted(folder.glob("views/*"))]
    files += sorted((folder / "colmap/sparse/0").glob("*"))
    return {
        str(file.relative_to(folder)): hashlib.sha256(file.read_bytes()).hexdigest()
        for file in files
    }


def test_the_contract_of_files_is_kept(undisturbed: Path) -> None:
    folder = _folder(undisturbed)
    names = {path.name for path in folder.iterdir()}
    expected = {
        "cloud.ply",
        "mesh.ply",
        "splats.ply",
        "transforms.json",
        "colmap",
        "views",
        "growth.png",
        "turntable.mp4",
    }
    assert expected | {"plan.png", "summary.json"} <= names
    summary = json.loads((folder / "summary.json").read_text())
    steps = summary["steps"]
    assert len(steps) == summary["views"]["generated"] > 2
    assert all({"plan", "generate", "align", "merge"} <= step["seconds"].keys() for step in steps)
    assert {"inputs", "views", "export", "splats", "measure"} == summary["seconds"].keys()
    assert summary["seconds"]["splats"] >= summary["splats"]["seconds"] > 0
    before, after = summary["metrics"]["inputs"], summary["metrics"]["completed"]
    assert after["completeness"] > before["completeness"] + 0.1
    assert after["accuracy"] > 0.9
    vertices = PlyData.read(folder / "cloud.ply")["vertex"]
    assert {"x", "nx", "red", "confidence"} <= {p.name for p in vertices.properties}
    assert len(vertices) == summary["points"]
    lengths = np.linalg.norm([vertices["nx"], vertices["ny"], vertices["nz"]], axis=0)
    assert np.abs(lengths - 1).max() < 1e-3


def test_the_splats_show_the_completed_views_in_the_photographs_world(undisturbed: Path) -> None:
    """Seen by the cameras that were written beside them, as another program would read both."""
    folder = _folder(undisturbed)
    splats = read_splats(folder / "splats.ply")
    summary = json.loads((folder / "summary.json").read_text())["splats"]
    assert len(splats) == len(PlyData.read(folder / "splats.ply")["vertex"]) == summary["gaussians"]
    scores = []
    for frame in open_scene(str(folder)).frames:
        view = frame.load()
        drawn = draw(rasterizer("numba"), splats, view.camera, 0.0, sh_degree=3).image
        scores.append(float(psnr(drawn.clamp(0, 1)[None], view.image[None])))
    assert min(scores) > 22
    assert np.mean(scores) == pytest.approx(summary["psnr"], abs=0.1)


def test_a_second_run_uses_the_splats_again(undisturbed: Path) -> None:
    before = (_folder(undisturbed) / "splats.ply").stat().st_mtime_ns
    assert "used again" in _finish(undisturbed)
    assert (_folder(undisturbed) / "splats.ply").stat().st_mtime_ns == before


@pytest.mark.parametrize("where", ["", "colmap"])
def test_what_is_written_is_read_back_by_the_readers_of_other_captures(
    undisturbed: Path, where: str
) -> None:
    """The inputs come back at the poses of the capture that they were taken from."""
    written = open_scene(str(_folder(undisturbed) / where))
    capture = {frame.name: frame for frame in open_scene("synthetic:cup/0000").frames}
    given = [f for f in written.frames if any(name in f.name for name in capture)]
    assert len(given) == 3
    for frame in given:
        original = capture[frame.name.split("_", 1)[1].removesuffix(".png")]
        assert np.allclose(
            frame.camera.world_to_cam.numpy(), original.camera.world_to_cam.numpy(), atol=1e-4
        )
    view = given[0].load()
    assert view.image.shape == (3, 40, 40)
    if not where:
        assert view.depth is not None
        assert 0.5 < float(view.depth.median()) < 6


@pytest.mark.slow
def test_killed_between_and_inside_views_the_result_is_the_same(
    undisturbed: Path, tmp_path: Path
) -> None:
    views = _folder(tmp_path) / "map"
    for reached in (1, 4, 5):
        process = _start(tmp_path)
        while process.poll() is None and len(list(views.glob("[0-9]*.safetensors"))) < reached:
            time.sleep(0.005)
        time.sleep(0.1 * (reached % 2))  # now and then in the middle of a view
        process.send_signal(signal.SIGKILL)
        process.wait()
    _finish(tmp_path)
    assert _content(tmp_path) == _content(undisturbed)


def test_a_second_run_with_other_options_is_refused(undisturbed: Path) -> None:
    said = _finish(undisturbed, "complete.tolerance=0.02", status=1)
    assert "made with different complete.tolerance (was " in said
    assert "Traceback" not in said


def test_a_dry_run_plans_and_generates_nothing(tmp_path: Path) -> None:
    said = _finish(tmp_path, "complete.dry_run=true")
    assert "views to make" in said
    assert "nothing was generated" in said
    assert (_folder(tmp_path) / "plan.png").stat().st_size > 1000
    assert not (_folder(tmp_path) / "summary.json").exists()
