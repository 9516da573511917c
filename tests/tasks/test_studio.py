"""The page of `task=studio` without a browser: what comes in, what is done, what goes out."""

import io
import json
import math
import shlex
import urllib.error
import urllib.request
import zipfile
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from hydra.core.hydra_config import HydraConfig
from PIL import Image

pytest.importorskip("viser", reason="needs viser: the extra `studio`")

import scenes
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from extrap_train.cli import TRAIN, compose_config
from extrap_train.config import TrainConfig
from extrap_train.errors import InputError
from extrap_train.tasks import complete
from extrap_train.tasks.studio import uploads
from extrap_train.tasks.studio.studio_page import Studio
from extrap_train.tasks.studio.studio_scene import StudioScene, camera_of, of_photographs, zipped
from extrap_train.tasks.studio.uploads import Upload


def _png(shade: int = 0) -> bytes:
    content = io.BytesIO()
    Image.new("RGB", (16, 12), (shade, 0, 0)).save(content, "png")
    return content.getvalue()


@pytest.mark.parametrize(
    "name",
    [
        "../a.png", "/etc/a.png", "a/b.png", "a\\b.png", ".a.png", "", "a.txt", "a.png\0",
        "transforms.json", "a\n.png", "x" * 101 + ".png", "ONE.PNG",
    ],
)  # fmt: skip
def test_a_name_that_is_no_photographs_is_refused(name: str, tmp_path: Path) -> None:
    upload = Upload(tmp_path)
    upload.add("one.png", _png())
    with pytest.raises(InputError, match=r"\.png"):
        upload.add(name, _png())
    assert [path.name for path in tmp_path.iterdir()] == ["one.png"]


@pytest.mark.parametrize("content", [b"", b"<svg/>", b"%PDF-1.4", _png()[:20]])
def test_what_is_no_picture_is_refused_and_not_kept(content: bytes, tmp_path: Path) -> None:
    with pytest.raises(InputError) as refused:
        Upload(tmp_path).add("one.png", content)
    assert str(refused.value).startswith("one.png")
    assert not any(tmp_path.iterdir())


def test_photographs_are_limited_in_size_and_number(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(uploads, "MAX_PHOTOGRAPHS", 2)
    monkeypatch.setattr(uploads, "MAX_BYTES", len(_png()))
    upload = Upload(tmp_path)
    with pytest.raises(InputError):
        upload.add("large.png", _png() + b" ")
    for name in ("1.png", "2.png"):
        upload.add(name, _png())
    with pytest.raises(InputError):
        upload.add("3.png", _png())
    monkeypatch.setattr(uploads, "MAX_PHOTOGRAPHS", 3)
    monkeypatch.setattr(uploads, "MAX_BYTES_TOGETHER", 2 * len(_png()))
    with pytest.raises(InputError):
        upload.add("3.png", _png())


def test_a_visitors_camera_is_one_of_ours() -> None:
    """Its square has the height of the canvas, or its width where that is less."""
    ours = scenes.orbit_camera(40.0, size=64)
    pose = ours.cam_to_world.double().numpy()
    rotation = pose[:3, :3]
    w = math.sqrt(1 + np.trace(rotation)) / 2
    axis = [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0],
            rotation[1, 0] - rotation[0, 1]]  # fmt: skip
    wxyz = np.array([w, *(np.array(axis) / (4 * w))])
    height = 2 * math.atan(32 / float(ours.intrinsics[1, 1]))
    for aspect, zoom in ((1.5, 1.0), (0.5, 2.0)):
        visitor = SimpleNamespace(wxyz=wxyz, position=pose[:3, 3], fov=height, aspect=aspect)
        camera = camera_of(visitor, 64)
        torch.testing.assert_close(camera.world_to_cam, ours.world_to_cam, atol=1e-5, rtol=0)
        assert float(camera.intrinsics[0, 0]) == pytest.approx(
            zoom * float(ours.intrinsics[0, 0]), rel=1e-5
        )


def test_a_result_is_packed_without_links_and_what_only_resuming_needs(tmp_path: Path) -> None:
    folder, secret = tmp_path / "result", tmp_path / "secret.txt"
    for name in ("cloud.ply", "views/1.png", "map/1.npz", ".hidden"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(name)
    secret.write_text("secret")
    (folder / "link.txt").symlink_to(secret)
    (folder / "folder").symlink_to(tmp_path)
    packed = zipfile.ZipFile(io.BytesIO(zipped(folder)))
    assert packed.namelist() == ["result/cloud.ply", "result/views/1.png"]
    assert packed.read("result/views/1.png") == b"views/1.png"


@pytest.fixture
def config(weights: Path, tmp_path: Path) -> TrainConfig:
    words = [
        "task=studio", "category=hydrant", "scene=synthetic:hydrant/0000", "data.frames=8",
        "data.image_size=32", "inputs=3", f"weights={weights}", "trainer.precision=32-true",
        "complete.generator=exact", "complete.exact_size=24", "complete.step_deg=150",
        "complete.splats.fit=false", "studio.port=8961", f"output={tmp_path}",
    ]  # fmt: skip
    made: TrainConfig = compose_config(TRAIN, words)
    return made


@pytest.fixture
def studio(config: TrainConfig) -> Iterator[Studio]:
    with Studio(config) as opened:
        yield opened


def _said(studio: Studio) -> str:
    return str(studio._said.content)


def test_a_completion_leaves_what_the_command_leaves(
    studio: Studio, config: TrainConfig, tmp_path: Path
) -> None:
    studio.do_next()
    assert "3 of 8" in _said(studio)
    studio._ask("completing", studio._complete)
    studio.do_next()
    assert "complete: " in _said(studio)
    assert studio._viewer.shown_points > 0
    own = complete.run(replace(config, task="complete", output=str(tmp_path / "command"))).folder
    made = tmp_path / "complete" / own.name
    assert sorted(p.relative_to(made) for p in made.rglob("*")) == sorted(
        p.relative_to(own) for p in own.rglob("*")
    )
    for name in ("manifest.json", "cloud.ply", "transforms.json"):
        assert (made / name).read_bytes() == (own / name).read_bytes()
    sent = []
    client = SimpleNamespace(send_file_download=lambda *file, **_: sent.append(file))
    for name in ("cloud.ply", "../../../etc/passwd", "everything (zip)"):
        studio._file.options = (*studio._file.options, name)
        studio._file.value = name
        studio._ask("packing", studio._send_to(client))
        studio.do_next()
    assert [name for name, _ in sent] == ["cloud.ply", f"{own.name}.zip", f"{own.name}.zip"]
    assert sent[0][1] == (own / "cloud.ply").read_bytes()


def test_a_completion_that_is_stopped_goes_on(studio: Studio, tmp_path: Path) -> None:
    studio.do_next()
    show = studio._viewer.show
    studio._viewer.show = lambda known: (show(known), studio._stop.set())  # type: ignore[method-assign]
    studio._ask("completing", studio._complete)
    studio.do_next()
    assert "stopped after 3 views" in _said(studio)
    assert not list(tmp_path.glob("complete/*/summary.json"))
    studio._viewer.show = show  # type: ignore[method-assign]
    studio._ask("completing", studio._complete)
    studio.do_next()
    assert list(tmp_path.glob("complete/*/summary.json"))


def test_a_view_is_generated_from_where_a_visitor_stands(studio: Studio) -> None:
    studio.do_next()
    assert studio._scene is not None
    camera = studio._scene.known().views[0].camera
    visitor = SimpleNamespace(
        wxyz=np.array([1.0, 0, 0, 0]), position=np.zeros(3), fov=1.0, aspect=1.0
    )
    pose = camera.cam_to_world.double().numpy()
    visitor.position = pose[:3, 3]
    studio._ask("generating", studio._look_from(SimpleNamespace(camera=visitor)))
    studio.do_next()
    assert "generated" in _said(studio)
    assert studio._picture.visible


def test_what_fails_is_told_in_one_line_and_the_page_goes_on(
    studio: Studio, config: TrainConfig
) -> None:
    bad = replace(config, scene="/no/such<b>folder")
    studio.do_next()
    studio._ask("opening", lambda: studio._open(bad))
    studio.do_next()
    assert "error: scene" in _said(studio)
    assert "<b>" not in _said(studio)
    studio._ask("dividing", lambda: str(1 // 0))
    studio.do_next()
    assert "error: ZeroDivisionError" in _said(studio)
    studio._ask("opening", lambda: studio._open(config))
    studio.do_next()
    assert "is open" in _said(studio)


def test_photographs_arrive_whole_or_not_at_all(studio: Studio, tmp_path: Path) -> None:
    studio.do_next()
    address = studio.url.replace("http", "ws") + "/upload"
    with connect(address) as socket:

        def send(name: str, content: bytes) -> str:
            socket.send(name)
            socket.send(content)
            return str(socket.recv())

        assert send("1.png", _png(1)) == ""
        assert send("../2.png", _png(2)) != ""
        assert send("2.png", b"no picture") != ""
        assert send("2.png", _png(2)) == ""
        with connect(address) as other, pytest.raises(Exception, match="another upload"):
            other.recv()
        socket.send("")
        assert "2 photographs" in str(socket.recv())
    assert studio._jobs.empty()
    assert not list(tmp_path.glob("studio/*"))
    with connect(address) as socket:
        for number in range(3):
            send(f"{number}.png", _png(number))
        socket.send("")
        assert socket.recv() == ""
    kept = tmp_path / "studio" / "photographs-1"
    assert sorted(path.name for path in kept.iterdir()) == ["0.png", "1.png", "2.png"]
    assert not studio._jobs.empty()


def test_nothing_else_is_served_and_to_nobody_else(studio: Studio, tmp_path: Path) -> None:
    (tmp_path / "summary.json").write_text(json.dumps({}))

    def status(path: str) -> int:
        try:
            with urllib.request.urlopen(f"{studio.url}{path}") as answer:
                return int(answer.status)
        except urllib.error.HTTPError as error:
            return error.code

    assert status("/drop") == 200
    assert status("/") == 200
    for path in ("/summary.json", f"{tmp_path}/summary.json", "/../../../../etc/passwd",
                 "/%2e%2e/%2e%2e/etc/passwd", "/upload", "/studio", "/complete"):  # fmt: skip
        assert status(path) == 404
    address = studio.url.replace("http", "ws") + "/upload"
    for origin in ("http://evil.example", "null"):
        with pytest.raises(InvalidStatus) as refused, ExitStack() as stack:
            stack.enter_context(connect(address, origin=origin))
        assert refused.value.response.status_code == 403


def test_dropped_photographs_get_their_depth_from_stereo(config: TrainConfig) -> None:
    dropped = of_photographs(replace(config, input_frames=["a"]), Path("somewhere"))
    assert dropped.depth.name == "stereo"
    assert (dropped.scene, dropped.input_frames) == ("somewhere", [])


def test_the_shown_command_has_the_pages_choices_and_the_users_other_options(
    config: TrainConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = ["task=studio", "category=cup", "inputs=9", "weights=my model", "studio.port=1"]
    hydra = SimpleNamespace(overrides=SimpleNamespace(task=given))
    monkeypatch.setattr(HydraConfig, "initialized", staticmethod(lambda: True))
    monkeypatch.setattr(HydraConfig, "get", staticmethod(lambda: hydra))
    options = replace(config, scene="a folder", inputs=4)
    scene = StudioScene(options, cast(Any, None), [], cast(Any, None))
    words = shlex.split(scene.command())
    assert words[:3] == ["python", "-m", "extrap_train"]
    assert {"task=complete", "scene=a folder", "inputs=4", "weights=my model"} < set(words)
    assert not {"task=studio", "inputs=9", "studio.port=1"} & set(words)
