"""`task=view`: the picture from a pose, or a walk around the scene, with the warp beside it.

The same in Python: `open_generator`, `open_views`, `walk`.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from rich.console import Console

from data_prep.frames import object_square
from data_prep.views import choose_frames, input_views
from extrap_train.config import (
    DatasetDepthConfig,
    DepthConfig,
    ModelConfig,
    SamplerConfig,
    TrainConfig,
    sampler_for,
)
from extrap_train.data.files import whole_folder
from extrap_train.data.posed import read_cameras
from extrap_train.data.scene import open_scene
from extrap_train.depth.build import depth_source
from extrap_train.diffusion.generator import DiffusionGenerator, GeneratedViews
from extrap_train.errors import InputError
from extrap_train.geometry.orbits import LEAST_VIEWS, orbit_cameras
from extrap_train.metrics import psnr, quantised
from extrap_train.pictures import contact_sheet, film, mark_holes, picture, picture_names
from extrap_train.tasks.scene_inputs import (
    SceneInputs,
    fabric_of,
    open_inputs,
    open_model,
    required_scene,
    trained_model,
)
from extrap_train.views import Camera, View, stack_cameras


def run(config: TrainConfig) -> None:
    """Paint the views that `pose` or `orbit` ask for, and leave them as PNG, GIF and MP4."""
    console = Console()
    required_scene(config)
    if (config.pose is None) == (config.orbit is None):
        raise InputError("task=view needs a pose=FRAME|FILE.json or an orbit=DEGREES, one of both")
    fabric = fabric_of(config)
    model = trained_model(config).to(fabric.device)
    inputs = open_inputs(config, model.config.warp_size, config.pose)
    names, cameras, truth = _queries(config, inputs, model.config.image_size)
    with fabric.autocast():
        generator = DiffusionGenerator(model, sampler_for(config.sampler, model.config))
        made = generator.generate(inputs.views, cameras, names, config.seed)
    folder = Path(config.output) / "view" / inputs.label
    with whole_folder(folder, lambda _: False) as whole:  # nothing of another pose's stays in it
        _write(made, inputs.views, names, whole, walk=config.orbit is not None)
        if truth is not None:
            picture(truth.image, whole / "truth.png")
    if truth is not None:
        console.print(_compared(made, truth, inputs))
    console.print(f"result: {folder}")


def _compared(made: GeneratedViews, truth: View, inputs: SceneInputs) -> str:
    if truth.name in {view.name for view in inputs.views}:
        return f"no PSNR: {truth.name} is an input itself; leave it out of input_frames"
    found = float(psnr(quantised(made.images), quantised(truth.image[None])))
    return f"PSNR against the photograph: {found:.2f} dB"


def open_generator(
    weights: str,
    adapter: str | None = None,
    sampler: SamplerConfig | None = None,
    config: ModelConfig | None = None,
) -> DiffusionGenerator:
    """The generator of a model folder, of a packaged model, or of a published checkpoint, which
    `config` describes; without `sampler` it samples as the model recommends.
    """
    model = open_model(weights, adapter, config)
    return DiffusionGenerator(model, sampler or model.config.sampler)


def open_views(
    scene: str,
    generator: DiffusionGenerator,
    inputs: int | None = None,
    depth: DepthConfig | None = None,
) -> list[View]:
    """A scene's views with depth, as the generator takes them: `inputs` spread ones, or all.

    `depth` is the data set's own by default; `StereoConfig()` estimates it.
    """
    sequence = open_scene(scene)
    chosen = choose_frames(sequence, (), inputs)
    source = depth_source(depth or DatasetDepthConfig())
    return input_views(sequence, chosen, source, generator.warp_size)


def walk(views: Sequence[View], degrees: float, frames: int) -> tuple[Camera, list[str]]:
    """Cameras around what the views look at, from the first view's azimuth on, and their names."""
    if len(views) < LEAST_VIEWS:
        raise InputError(
            f"an orbit needs {LEAST_VIEWS} input views to say which way it leans, not "
            f"{len(views)}; give more, or a pose="
        )
    cameras = stack_cameras([view.camera for view in views])
    around = orbit_cameras(cameras, math.radians(degrees), frames)
    return around, [f"{index:03d}" for index in range(frames)]


def _queries(
    config: TrainConfig, inputs: SceneInputs, size: int
) -> tuple[list[str], Camera, View | None]:
    """Names and cameras of the queries, and the photograph where there is one."""
    if config.orbit is not None:
        cameras, names = walk(inputs.views, config.orbit, config.frames)
        return names, cameras, None
    assert config.pose is not None
    if Path(config.pose).suffix == ".json":
        names, cameras = read_cameras(Path(config.pose))
        return names, cameras, None
    known = {frame.name: frame for frame in inputs.sequence.frames}
    if config.pose not in known:
        raise InputError(
            f"pose={config.pose}: is neither a frame of the scene nor a .json file; its frames are "
            f"{', '.join(list(known)[:4])}, …"
        )
    square = object_square(known[config.pose].load(depth=False), size)
    truth = replace(square, name=config.pose)
    return [config.pose], stack_cameras([truth.camera]), truth


def _write(
    made: GeneratedViews, views: list[View], names: list[str], folder: Path, *, walk: bool
) -> None:
    warps = mark_holes(made.warp.image, made.warp.mask)
    if walk:
        for end in ("gif", "mp4"):
            film(made.images, folder / f"orbit.{end}")
            film(warps, folder / f"orbit_warp.{end}")
    for stem, image, warp in zip(picture_names(names), made.images, warps, strict=True):
        picture(image, folder / "views" / f"{stem}.png")
        picture(warp, folder / "views" / f"{stem}_warp.png")
    size = made.images.shape[-1]
    nearest = torch.stack([views[row[0]].resized(size, size).image for row in made.references])
    shown = {"nearest photo": nearest, "warp": warps, "view": made.images}
    contact_sheet(shown, folder / "sheet.png")
