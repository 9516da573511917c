"""The page of `task=studio`: what is on it, and what its buttons have done.

The server's threads only put work into a queue; `Studio.do_next` does it in the caller's thread,
one thing after another.
"""

import html
import json
import logging
import math
import threading
import traceback
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image

from extrap_train.config import TrainConfig
from extrap_train.data.image_files import to_eight_bits
from extrap_train.diffusion.generator import DiffusionGenerator, GeneratedViews
from extrap_train.errors import InputError
from extrap_train.figures import mark_holes
from extrap_train.reconstruction.global_map import GlobalMap
from extrap_train.reconstruction.viewer import CloudViewer
from extrap_train.reconstruction.viewer_pages import Routes
from extrap_train.tasks import complete
from extrap_train.tasks.scene_model import device_of, scene_generator, trained_model
from extrap_train.tasks.studio.studio_scene import (
    StudioScene,
    camera_of,
    of_photographs,
    open_studio_scene,
    result_files,
    zipped,
)
from extrap_train.tasks.studio.uploads import MAX_BYTES, Receiver
from extrap_train.terminal import open_bars, terminal
from extrap_train.views import Camera

_NOWHERE = "choose a photograph"
_EVERYTHING = "everything (zip)"
_DROP_ZONE = '<iframe src="drop" style="width:100%;height:104px;border:0"></iframe>'
_REPORT_EVERY_S = 0.3
_PICTURE_WIDTH = 640
_BOLD = "font-weight:600"
_START = "Drop photographs below to begin, or start the command with scene=…"


class Studio:
    """The page and the scene on it, which all of its visitors share."""

    def __init__(self, config: TrainConfig) -> None:
        self._config = config
        self._jobs: SimpleQueue[tuple[str, Callable[[], str]]] = SimpleQueue()
        self._scene: StudioScene | None = None
        self._result: Path | None = None
        self._generator: DiffusionGenerator | None = None
        self._stop, self._closed = threading.Event(), threading.Event()
        self._saying = threading.Lock()
        self._notes = _Notes()
        page = files(__package__).joinpath("drop.html").read_bytes()
        receiver = Receiver(Path(config.output) / "studio", self._on_received)
        self._viewer = CloudViewer(
            config.studio.port,
            config.complete.confidence.votes,
            config.studio.host,
            option="studio.host",
            routes=Routes(
                {"/drop": page.replace(b"MAX_BYTES", str(MAX_BYTES).encode())},
                {"/upload": receiver},
            ),
        )
        self.url = self._viewer.url
        self._exits = ExitStack()
        self._exits.callback(self._viewer.close)
        self._exits.callback(self._closed.set)
        self._fill_panel()
        threading.Thread(target=self._report, daemon=True).start()
        if config.scene is not None:
            self._ask("opening the scene", lambda: self._open(config))

    def __enter__(self) -> "Studio":
        return self

    def __exit__(self, *_: object) -> None:
        self._exits.close()

    def do_next(self) -> None:
        """Wait for the next request and carry it out; its failure is shown on the page."""
        label, job = self._jobs.get()
        self._notes.lines.clear()
        self._show_state(f"{label} …", busy=True)
        logger = logging.getLogger("extrap_train")
        logger.addHandler(self._notes)
        try:
            said = job()
        except _Stopped as stopped:
            said = str(stopped)
        except InputError as error:
            said = f"error: {error}"
        except Exception as error:
            traceback.print_exc()
            said = f"error: {type(error).__name__}: {error} (the terminal has the details)"
        finally:
            logger.removeHandler(self._notes)
        terminal(stderr=said.startswith("error")).print(said)
        self._show_state(said, busy=False)

    def _fill_panel(self) -> None:
        gui: Any = self._viewer.server.gui  # its typing makes values read-only
        gui.set_panel_label("extrap-train studio")
        gui.main_panel.dock_right()
        gui.main_panel.set_width(380)
        self._said = gui.add_html("", order=-9)
        self._bar = gui.add_progress_bar(0.0, visible=False, order=-8)
        self._noted = gui.add_html("", order=-7)
        with gui.add_folder("1  Photographs", order=-6):
            gui.add_html(_DROP_ZONE)
            self._inputs = gui.add_slider("used", min=2, max=3, step=1, initial_value=2)
            reopen = gui.add_button("Open again with this many")
        with gui.add_folder("2  View", order=-5):
            self._pose = gui.add_dropdown("stand at", (_NOWHERE,))
            look = gui.add_button("Generate the view from here")
            self._picture = gui.add_image(np.zeros((1, 2, 3), np.uint8), visible=False)
        with gui.add_folder("3  Completion", order=-4):
            self._replace = gui.add_checkbox("replace result", initial_value=False)
            whole = gui.add_button("Complete the scene")
            self._stopper = gui.add_button("Stop after this view", disabled=True)
            self._command = gui.add_html("")
        with gui.add_folder("4  Download", order=-3):
            self._file = gui.add_dropdown("file", (_EVERYTHING,))
            self._download = gui.add_button("Download")
        self._of_scene = (reopen, look, whole)
        reopen.on_click(lambda _: self._ask("opening the scene", self._open_again))
        look.on_click(lambda event: self._ask("generating", self._look_from(event.client)))
        whole.on_click(lambda _: self._ask("completing", self._complete))
        self._stopper.on_click(lambda _: self._stop.set())
        self._pose.on_update(self._on_pose_chosen)
        self._download.on_click(lambda event: self._ask("packing", self._send_to(event.client)))
        self._show_state(_START, busy=False)

    def _ask(self, label: str, job: Callable[[], str]) -> None:
        self._jobs.put((label, job))

    def _show_state(self, said: str, *, busy: bool) -> None:
        with self._saying:
            self._said.content = _html(said, _BOLD)
            self._bar.visible = False
        self._noted.content = _html("\n".join(self._notes.lines), "color:#a60")
        for button in self._of_scene:
            button.disabled = busy or self._scene is None
        self._download.disabled = busy or self._result is None
        self._stopper.disabled = True

    def _report(self) -> None:
        """Show on the page how far the innermost bar of the terminal is."""
        while not self._closed.wait(_REPORT_EVERY_S):
            with self._saying:
                for bar in open_bars()[-1:]:
                    self._said.content = _html(f"{bar.label}: {bar.state}", _BOLD)
                    self._bar.value = 100.0 * bar.done / bar.total
                    self._bar.visible = True

    def _on_received(self, folder: Path) -> None:
        config = of_photographs(self._config, folder)
        self._ask("opening the photographs", lambda: self._open(config))

    def _open_again(self) -> str:
        assert self._scene is not None
        inputs = int(self._inputs.value)
        return self._open(replace(self._scene.config, inputs=inputs, input_frames=[]))

    def _open(self, config: TrainConfig) -> str:
        if self._generator is None:
            model = trained_model(config).to(device_of(config))
            self._generator = scene_generator(config, model)
        scene = open_studio_scene(config, self._generator.warp_size)
        self._scene, self._result = scene, None
        self._viewer.clear()
        for name, camera in scene.others().items():
            self._viewer.add_camera(name, camera)
        self._viewer.show(scene.known())
        names = [frame.name for frame in scene.sequence.frames]
        self._pose.options = (_NOWHERE, *names)
        self._inputs.max = max(3, len(names))
        self._inputs.value = len(scene.views)
        self._file.options = (_EVERYTHING,)
        self._command.content = _html(scene.command(), "font-family:monospace;color:#666")
        self._picture.visible = False
        used = f"{len(scene.views)} of {len(names)} photographs are used (blue)"
        return f"{config.scene} is open: {used}"

    def _on_pose_chosen(self, event: Any) -> None:
        scene, name = self._scene, self._pose.value
        if event.client_id is not None and scene is not None and name in self._pose.options[1:]:
            _stand(event.client, scene.camera(name))
            self._pose.value = _NOWHERE  # so that the same one can be chosen again

    def _look_from(self, client: Any) -> Callable[[], str]:
        """A job that generates what a visitor sees now."""
        seen = camera_of(client.camera, _PICTURE_WIDTH)

        def look() -> str:
            assert self._scene is not None
            assert self._generator is not None
            made = self._scene.view_from(seen, self._generator)
            self._picture.image, self._picture.visible = _side_by_side(made), True
            share = 100 * float(made.warp.mask.mean())
            return f"left: the photographs' warp, right: generated; they show {share:.0f} % of it"

        return look

    def _complete(self) -> str:
        assert self._scene is not None
        self._stop.clear()
        self._stopper.disabled = False
        self._result = None
        config = replace(self._scene.config, resume=not self._replace.value)
        folder = complete.run(config, self._watch).folder
        self._result = folder
        self._file.options = (_EVERYTHING, *result_files(folder))
        summary = json.loads((folder / "summary.json").read_bytes())
        count = sum(summary["views"].values())
        return f"complete: {count} views, {summary['points']:,} points\nresult: {folder}"

    def _watch(self, scene_map: GlobalMap) -> None:
        self._viewer.show(scene_map)
        if self._stop.is_set():
            raise _Stopped(f"stopped after {len(scene_map)} views; complete again to continue")

    def _send_to(self, client: Any) -> Callable[[], str]:
        """A job that sends the chosen file of the result to a visitor."""

        def send() -> str:
            folder, name = self._result, self._file.value
            assert folder is not None
            if name in result_files(folder):
                client.send_file_download(name, (folder / name).read_bytes(), save_immediately=True)
            else:
                name = f"{folder.name}.zip"
                client.send_file_download(name, zipped(folder), save_immediately=True)
            return f"{name} was sent\nresult: {folder}"

        return send


class _Stopped(Exception):
    """A visitor ended a completion."""


class _Notes(logging.Handler):
    """Keeps warnings for the page; the terminal shows them as well."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        """See `logging.Handler.emit`."""
        self.lines.append(record.getMessage())
        assert logging.lastResort is not None
        logging.lastResort.handle(record)


def _html(text: str, style: str) -> str:
    """Text from anywhere as it is, for the panel."""
    frame = "padding:0 12px 8px;font-size:13px;overflow-wrap:anywhere;white-space:pre-wrap"
    return f'<div style="{frame};{style}">{html.escape(text)}</div>' if text else ""


def _stand(client: Any, camera: Camera) -> None:
    """Let a visitor stand where a camera does, with a lens that shows its largest square."""
    pose = camera.cam_to_world.double().numpy()
    _, down, forward, position = pose[:3].T
    side = min(camera.height, camera.width)
    with client.atomic():
        client.camera.up_direction = -down
        client.camera.position = position
        client.camera.look_at = position + np.linalg.norm(position) * forward
        client.camera.fov = 2 * math.atan(side / 2 / float(camera.intrinsics[1, 1]))


def _side_by_side(made: GeneratedViews) -> UInt8[np.ndarray, "h w 3"]:
    """Warp with its holes marked, and view."""
    warp = mark_holes(made.warp.image, made.warp.mask)[0]
    pixels = to_eight_bits(torch.cat([warp, made.images[0]], -1)).transpose(1, 2, 0)
    size = _PICTURE_WIDTH, _PICTURE_WIDTH // 2
    return np.asarray(Image.fromarray(pixels).resize(size, Image.Resampling.BICUBIC))
