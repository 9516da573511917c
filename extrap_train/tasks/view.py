"""`task=view`: the picture from a pose, or a walk around the scene, and the warp it came from.

The same in Python: `extrap_train.open_generator`, `open_views` and `walk_around`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from rich.console import Console

from extrap_train.config import TrainConfig
from extrap_train.data.sequences import FrameSequence
from extrap_train.data.square_frames import object_square
from extrap_train.data.transforms_json import read_cameras
from extrap_train.diffusion.generator import GeneratedViews
from extrap_train.errors import InputError, did_you_mean
from extrap_train.figures import (
    draw_contact_sheet,
    mark_holes,
    picture_names,
    save_picture,
    write_film,
)
from extrap_train.geometry.viewpoints import MIN_VIEWS, orbit_cameras
from extrap_train.metrics import psnr, quantised
from extrap_train.store.manifest import claim
from extrap_train.store.records import write_record
from extrap_train.tasks.scene_inputs import (
    InputViews,
    input_frames,
    label_of,
    nothing_kept,
    open_inputs,
    open_sequence,
    photograph_digests,
    require_space,
    result_folder,
    scene_manifest,
)
from extrap_train.tasks.scene_model import (
    UsedWeights,
    device_of,
    frames_learnt,
    generate_views,
    model_options,
    named_weights,
    scene_generator,
    trained_model,
)
from extrap_train.terminal import terminal
from extrap_train.views import Camera, View, stack_cameras

_UNSEEN_SHARE = 0.02
"""Share of a view that the inputs show: with less it is as good as turned away."""
_PICTURES_PER_VIEW = 8
"""View and warp, in files of their own, in both films and on the sheet."""


@dataclass(frozen=True)
class _Query:
    """What is asked for, as far as it is known before any depth is."""

    names: list[str]
    cameras: Camera | None
    """None on an orbit, which follows from the inputs."""
    photograph: View | None
    """Photograph of the frame that is asked for, as it was taken."""


@dataclass(frozen=True)
class _Summary:
    """`summary.json` of a view: what it shows, and from what it was made."""

    generated_with: UsedWeights
    photographs: dict[str, str]
    """SHA-256 of the content of the inputs, by the frames' names."""
    shown: dict[str, float]
    """Share of each view that the inputs show."""
    psnr: float | None
    """In dB against the photograph; None where there is none to compare with."""


def run(config: TrainConfig) -> None:
    """Generate the views that `pose` or `orbit` ask for, and leave them as PNG, GIF and MP4.

    They replace what was asked of the same scene, inputs and weights before.
    """
    console = terminal()
    named_weights(config)  # refused before cameras are estimated, which may take minutes
    sequence = open_sequence(config)
    config = replace(config, pose=_as_named(config.pose, sequence))
    query = _query(config, sequence)
    folder, used = result_folder(config, label_of(sequence)), UsedWeights.of(config)
    # Which frames are inputs depends on the pose, so all of the capture count.
    manifest = scene_manifest(config, sequence.frames, used.inputs(), model_options(config))
    with nothing_kept(), claim(folder, manifest, resume=config.resume) as result:
        model = trained_model(config).to(device_of(config))
        size = model.config.image_size
        require_space(folder, len(query.names) * _PICTURES_PER_VIEW * 3 * size**2)
        inputs = open_inputs(config, sequence, model.config.warp_size, config.pose)
        cameras, truth = _cameras(query, inputs.views, config, size)
        generator = scene_generator(config, model)
        made = generate_views(generator, inputs.views, cameras, query.names, config)
        console.print(f"generated with {used} at {size} x {size} pixels, which the weights fix")
        _print_shares(made, query.names, console)
        score, why_not = _compare(made, truth, inputs, config, sequence)
        with result.replace() as whole:
            _write(made, inputs.views, query.names, whole, walk=config.orbit is not None)
            if truth is not None:
                save_picture(truth.image, whole / "truth.png")
            names = {view.name for view in inputs.views}
            read = photograph_digests(f for f in sequence.frames if f.name in names)
            shown = dict(zip(query.names, _shares(made), strict=True))
            write_record(whole / "summary.json", _Summary(used, read, shown, score))
    if truth is not None:
        console.print(why_not or f"PSNR against the photograph: {score:.2f} dB")
    console.print(f"result: {folder}")


def _shares(made: GeneratedViews) -> list[float]:
    """How much of each view the inputs show."""
    return made.warp.mask.flatten(1).mean(1).tolist()


def _print_shares(made: GeneratedViews, names: list[str], console: Console) -> None:
    """How much of each view the inputs show, which is what the picture can be trusted for."""
    shares = _shares(made)
    least, most = (f"{100 * share:.0f}" for share in (min(shares), max(shares)))
    which = names[0] if len(names) == 1 else "the views"
    span = least if least == most else f"{least} to {most}"
    console.print(f"the inputs show {span} % of {which}")
    unseen = [name for name, share in zip(names, shares, strict=True) if share < _UNSEEN_SHARE]
    if unseen:
        more = f" and {len(unseen) - 1} more" if len(unseen) > 1 else ""
        terminal(stderr=True).print(
            f"the inputs show next to nothing of {unseen[0]}{more}, which is made up: does its "
            "camera look at the scene, from near enough? A pose file has OpenGL's axes (+X right, "
            "+Y up, −Z forward) and the scene's unit"
        )


def _compare(
    made: GeneratedViews,
    truth: View | None,
    inputs: InputViews,
    config: TrainConfig,
    sequence: FrameSequence,
) -> tuple[float | None, str]:
    """PSNR in dB against the photograph, or why there is none."""
    if truth is None:
        return None, ""
    if truth.name in {view.name for view in inputs.views}:
        return None, f"no PSNR: {truth.name} is an input itself; leave it out of input_frames"
    if frames_learnt(config, [f for f in sequence.frames if f.name == truth.name]):
        return None, f"no PSNR: the adapter was trained on {truth.name}"
    return float(psnr(quantised(made.images), quantised(truth.image[None]))), ""


def walk_around(views: Sequence[View], degrees: float, frames: int) -> tuple[Camera, list[str]]:
    """Cameras around what the views look at, from the first view's azimuth on, and their names."""
    _require_orbit(len(views))
    cameras = stack_cameras([view.camera for view in views])
    return orbit_cameras(cameras, math.radians(degrees), frames), _places(frames)


def _require_orbit(views: int) -> None:
    if views < MIN_VIEWS:
        raise InputError(
            f"an orbit needs {MIN_VIEWS} input views to say which way it leans, not {views}; "
            "give more, or a pose="
        )


def _places(frames: int) -> list[str]:
    return [f"{index:03d}" for index in range(frames)]


def _as_named(pose: str | None, sequence: FrameSequence) -> str | None:
    """The frame that `pose` names, in the case in which the scene has it."""
    names = [frame.name for frame in sequence.frames if pose is not None]
    alike = [name for name in names if name.casefold() == str(pose).casefold()]
    return alike[0] if len(alike) == 1 else pose


def _query(config: TrainConfig, sequence: FrameSequence) -> _Query:
    """InputError where nothing can be generated of what is asked for."""
    if (config.pose is None) == (config.orbit is None):
        raise InputError("task=view needs a pose=FRAME|FILE.json or an orbit=DEGREES, one of both")
    if config.pose is None:
        _require_orbit(len(input_frames(config, sequence)[1]))
        return _Query(_places(config.frames), None, None)
    if Path(config.pose).suffix == ".json":
        return _Query(*read_cameras(Path(config.pose)), None)
    known = {frame.name: frame for frame in sequence.frames}
    if config.pose not in known:
        raise InputError(
            f"pose={config.pose}: is neither a frame of the scene nor a .json file; "
            f"{did_you_mean(config.pose, known)}"
        )
    return _Query([config.pose], None, known[config.pose].load(depth=False))


def _cameras(
    query: _Query, views: list[View], config: TrainConfig, size: int
) -> tuple[Camera, View | None]:
    """The cameras to generate, and the photograph at the pictures' size where there is one."""
    if query.photograph is not None:
        square = object_square(query.photograph, size)
        truth = replace(square, name=query.names[0])
        return stack_cameras([truth.camera]), truth
    if query.cameras is not None:
        return query.cameras, None
    assert config.orbit is not None
    return walk_around(views, config.orbit, config.frames)[0], None


def _write(
    made: GeneratedViews, views: list[View], names: list[str], folder: Path, *, walk: bool
) -> None:
    warps = mark_holes(made.warp.image, made.warp.mask)
    if walk:
        for end in ("gif", "mp4"):
            write_film(made.images, folder / f"orbit.{end}")
            write_film(warps, folder / f"orbit_warp.{end}")
    for stem, image, warp in zip(picture_names(names), made.images, warps, strict=True):
        save_picture(image, folder / "views" / f"{stem}.png")
        save_picture(warp, folder / "views" / f"{stem}_warp.png")
    size = made.images.shape[-1]
    nearest = torch.stack([views[row[0]].resized(size, size).image for row in made.references])
    shown = {"nearest photo": nearest, "warp": warps, "view": made.images}
    draw_contact_sheet(shown, folder / "sheet.png")
