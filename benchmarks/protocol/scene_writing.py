"""Preparing a draw: its frames are read, their depth is found, and its folder is written."""

import hashlib
import logging
from collections.abc import Sequence as ListOf
from pathlib import Path

import torch

from benchmarks.methods.base import Stopwatch
from benchmarks.protocol.array_files import npy_bytes
from benchmarks.protocol.captures import Capture
from benchmarks.protocol.draws import Draw
from benchmarks.protocol.prepared_scene import (
    INPUTS,
    SCENE_FORMAT,
    CameraRecord,
    Scene,
    SceneRecord,
)
from extrap_train.config import DatasetDepthConfig, DepthConfig, RulesConfig
from extrap_train.data.examples import query_batch
from extrap_train.data.image_files import png_bytes, to_eight_bits
from extrap_train.depth import NoDepthError
from extrap_train.depth.sources import depth_source
from extrap_train.errors import InputError
from extrap_train.geometry.viewpoints import pairwise_angles, scene_center
from extrap_train.geometry.warp import compute_warp
from extrap_train.store.atomic import atomic_folder
from extrap_train.store.records import write_record
from extrap_train.views import Camera, View, stack_cameras, stack_poses

LOG = logging.getLogger(__name__)


def prepare_scene(
    folder: Path,
    capture: Capture,
    draw: Draw,
    rules: RulesConfig,
    depth: DepthConfig,
    origin: str,
) -> Scene:
    """Read a draw's frames and write its folder and its truth's, or open what is there.

    `depth` is the source that `rules.depth` names. `origin` names all that decides the content;
    what is of another origin, or lacks or has changed a file, is replaced.
    """
    there = _whole_scene(folder, origin)
    if there is not None:
        return there
    contents, record = _scene(capture, draw, rules, depth, origin)
    truth = Scene(folder, record).truth_folder
    for place, is_input in ((truth, False), (folder, True)):  # the record comes last
        with atomic_folder(place) as made:
            for name, content in contents.items():
                if name.startswith(INPUTS) == is_input:
                    (made / name).parent.mkdir(exist_ok=True)
                    (made / name).write_bytes(content)
            if is_input:
                write_record(made / "scene.json", record)
    return Scene.open(folder)


def _whole_scene(folder: Path, origin: str) -> Scene | None:
    """What is there already, if it is all there."""
    try:
        scene = Scene.open(folder)
    except InputError:
        return None
    return scene if scene.record.origin == origin and not scene.changed_files() else None


def _scene(
    capture: Capture, draw: Draw, rules: RulesConfig, depth: DepthConfig, origin: str
) -> tuple[dict[str, bytes], SceneRecord]:
    """A draw's files by name, and its record."""
    size = rules.image_size
    frames = {frame.name: frame for frame in capture.sequence.frames}
    missing = [name for name in (*draw.inputs, *draw.targets) if name not in frames]
    if missing:
        raise InputError(
            f"{draw.category}/{draw.sequence}: has no frame {missing[0]}, which the protocol names"
        )
    is_oracle = isinstance(depth, DatasetDepthConfig)  # no other source sees the data set's depth
    photographs = [frames[name].load(depth=is_oracle) for name in draw.inputs]
    fine_size = size * _fine_scale(photographs, rules)
    inputs, seconds = _with_depth(photographs, depth, fine_size)
    targets = [frames[name].load().squared(size) for name in draw.targets]
    cameras = stack_cameras([view.camera for view in targets])
    depths = [view.depth for view in inputs if view.depth is not None]
    warp = compute_warp(query_batch(inputs, cameras, len(inputs), fine_size)[0], size).warp
    assert warp is not None
    pictures = {
        "inputs": torch.stack([view.image for view in inputs]),
        "truth": torch.stack([view.image for view in targets]),
        "warps": warp.image * warp.mask[:, None],
        "masks": warp.mask[:, None].expand(-1, 3, -1, -1),
    }
    contents = {
        f"{kind}/{i}.png": png_bytes(to_eight_bits(image.permute(1, 2, 0)))
        for kind, images in pictures.items()
        for i, image in enumerate(images)
    }
    contents["inputs/depth.npy"] = npy_bytes(torch.stack(depths))
    known = [view.depth for view in targets if view.depth is not None]
    if len(known) == len(targets):
        contents["truth/depth.npy"] = npy_bytes(torch.stack(known))
    if capture.surface is not None:
        surface = capture.surface()
        contents["truth/object.npy"] = npy_bytes(surface.object)
        contents["truth/surroundings.npy"] = npy_bytes(surface.surroundings)
    record = SceneRecord(
        format=SCENE_FORMAT,
        origin=origin,
        draw=draw,
        image_size=size,
        fine_size=fine_size,
        depth_seconds=seconds,
        inputs=[_camera_record(view.camera.resized(size, size)) for view in inputs],
        targets=[_camera_record(view.camera) for view in targets],
        angles_rad=_angles_to_nearest(inputs, targets),
        files={name: hashlib.sha256(content).hexdigest() for name, content in contents.items()},
    )
    return contents, record


def _fine_scale(photographs: ListOf[View], rules: RulesConfig) -> int:
    """What the rules say, but nothing is scaled up."""
    smallest = min(min(view.camera.height, view.camera.width) for view in photographs)
    return max(1, min(rules.fine_scale, smallest // rules.image_size))


def _with_depth(
    photographs: ListOf[View], depth: DepthConfig, size: int
) -> tuple[list[View], float]:
    """The inputs at a size with their depth, and how long finding it took.

    Depth is found at its source's own resolution, from the inputs alone. It is unknown everywhere,
    with a warning, where the inputs stand too far apart: not every method needs it.
    """
    source = depth_source(depth)
    side = max(size, source.image_size or 0)
    large = [view.squared(side) for view in photographs]
    with Stopwatch() as watch:
        try:
            found = [one.reliable() for one in source.depth_maps(large)]
        except NoDepthError as error:
            LOG.warning("%s", error)
            found = [torch.zeros_like(view.image[0]) for view in large]
    views = []
    for view, its_depth in zip(large, found, strict=True):
        posed = View(view.image, view.camera, its_depth, name=view.name)
        views.append(posed.resized(size, size))
    return views, 0.0 if isinstance(depth, DatasetDepthConfig) else watch.seconds


def _angles_to_nearest(inputs: ListOf[View], targets: ListOf[View]) -> list[float]:
    cameras = stack_poses([view.camera for view in (*inputs, *targets)])
    angles = pairwise_angles(cameras, scene_center(cameras))
    return [float(a) for a in angles[len(inputs) :, : len(inputs)].min(1)]


def _camera_record(camera: Camera) -> CameraRecord:
    return CameraRecord(camera.world_to_cam.tolist(), camera.intrinsics.tolist())
