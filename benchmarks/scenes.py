"""One draw on disk: what a method receives, and apart from it what its images are scored against.

<folder>/scene.json            the draw, cameras, angles, hashes; written last
         inputs/0.png …        inputs/depth.npy (0 = unknown; found from the inputs alone), at
                               the finer size
         truth/0.png …         truth/depth.npy, truth/object.npy and truth/surroundings.npy (points)
                               where the capture knows them
         warps/0.png …         masks/0.png …: the fused warp of all inputs, and what it reaches
"""

import hashlib
import io
import os
import shutil
from collections.abc import Mapping
from collections.abc import Sequence as ListOf
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from benchmarks.captures import Capture, TrueSurface
from benchmarks.files import json_bytes
from benchmarks.methods.base import SceneInputs, Stopwatch
from benchmarks.protocol import Draw, digest, draw_of
from benchmarks.recorded_depth import RecordedDepth
from extrap_train.config import DatasetDepthConfig, DepthConfig, RulesConfig, StereoConfig
from extrap_train.data.files import write_whole
from extrap_train.data.images import read_image, to_eight_bits
from extrap_train.data.json_files import read_json
from extrap_train.data.module import with_warp
from extrap_train.data.queries import query_batch
from extrap_train.depth.build import depth_source
from extrap_train.errors import InputError
from extrap_train.geometry.viewpoints import pairwise_angles, scene_center
from extrap_train.views import Camera, View, stack_cameras

FORMAT = 2
DEPTHS: Mapping[str, DepthConfig] = {"dataset": DatasetDepthConfig(), "stereo": StereoConfig()}


@dataclass(frozen=True)
class Truth:
    """What a method's images are scored against; no method sees it."""

    images: Float[Tensor, "n 3 h w"]
    cameras: Camera
    warps: Float[Tensor, "n 3 h w"]
    """The fused warp of all inputs, black where it does not reach."""
    masks: Float[Tensor, "n h w"]
    """1 where that warp reaches, else 0."""
    depths: Float[Tensor, "n h w"] | None
    surface: TrueSurface | None


@dataclass(frozen=True)
class Scene:
    """One prepared draw."""

    folder: Path
    record: dict[str, Any]

    @classmethod
    def open(cls, folder: Path) -> "Scene":
        """A prepared draw; raises InputError where its record is missing or damaged."""
        record = read_json(folder / "scene.json")
        if not isinstance(record, dict) or record.get("format") != FORMAT:
            raise InputError(f"{folder / 'scene.json'}: is no prepared scene; delete {folder}")
        return cls(folder, record)

    @property
    def draw(self) -> Draw:
        """Which frames of which capture it holds."""
        return draw_of(self.record["draw"])

    @property
    def data_hash(self) -> str:
        """Of every file and camera in it."""
        return digest([self.record[name] for name in ("draw", "cameras", "files")])

    @property
    def angles_rad(self) -> list[float]:
        """Angle of every target to its nearest input, about the scene's centre."""
        return list(self.record["angles_rad"])

    def changed_files(self) -> list[str]:
        """Files that are missing, or not what their hash says."""
        return [
            name
            for name, stated in self.record["files"].items()
            if not (self.folder / name).is_file() or _hash(self.folder / name) != stated
        ]

    def inputs(self) -> SceneInputs:
        """What a method receives; nothing of the truth is read."""
        draw = self.draw
        cameras = self._cameras("inputs")
        side, size = self.record["fine_size"], self.record["image_size"]
        images = self._pictures("inputs", len(draw.inputs), side)
        depths = torch.from_numpy(np.load(self.folder / "inputs" / "depth.npy"))
        fine = [
            View(image, cameras[i].resized(side, side), depths[i], name=draw.inputs[i])
            for i, image in enumerate(images)
        ]
        return SceneInputs(
            category=draw.category,
            views=tuple(view.resized(size, size) for view in fine),
            targets=self._cameras("targets"),
            depth_source=RecordedDepth(float(self.record["depth_seconds"])),
            seed=draw.seed,
            fine_views=tuple(fine),
        )

    def truth(self) -> Truth:
        """What the images are scored against."""
        count = len(self.draw.targets)
        return Truth(
            images=self._pictures("truth", count),
            cameras=self._cameras("targets"),
            warps=self._pictures("warps", count),
            masks=(self._pictures("masks", count)[:, 0] > 0.5).float(),
            depths=self._array("truth/depth.npy"),
            surface=self._surface(),
        )

    def _surface(self) -> TrueSurface | None:
        found = [self._array(f"truth/{name}.npy") for name in ("object", "surroundings")]
        return None if found[0] is None or found[1] is None else TrueSurface(found[0], found[1])

    def _pictures(self, kind: str, count: int, side: int | None = None) -> Float[Tensor, "n 3 h w"]:
        size = (side or self.record["image_size"],) * 2
        return torch.stack(
            [read_image(self.folder / kind / f"{i}.png", size) for i in range(count)]
        )

    def _array(self, name: str) -> Tensor | None:
        path = self.folder / name
        return torch.from_numpy(np.load(path)) if name in self.record["files"] else None

    def _cameras(self, kind: str) -> Camera:
        entries = self.record["cameras"][kind]
        size = self.record["image_size"]
        return Camera(
            torch.tensor([entry["world_to_cam"] for entry in entries]),
            torch.tensor([entry["intrinsics"] for entry in entries]),
            size,
            size,
        )


def prepare_scene(
    folder: Path, capture: Capture, draw: Draw, rules: RulesConfig, origin: str
) -> Scene:
    """Read a draw's frames and write its folder, or open the one that is there.

    `origin` names all that decides the content; a folder of another origin, or with a changed file,
    is made anew.
    """
    if (folder / "scene.json").is_file():
        scene = Scene.open(folder)
        if scene.record["origin"] == origin and not scene.changed_files():
            return scene
    workshop = folder.with_name(f".{folder.name}.{os.getpid()}")
    shutil.rmtree(workshop, ignore_errors=True)
    try:
        record = _write_scene(workshop, capture, draw, rules)
        write_whole(workshop / "scene.json", json_bytes({**record, "origin": origin}))
        shutil.rmtree(folder, ignore_errors=True)
        workshop.replace(folder)
    finally:
        shutil.rmtree(workshop, ignore_errors=True)
    return Scene.open(folder)


def _write_scene(folder: Path, capture: Capture, draw: Draw, rules: RulesConfig) -> dict[str, Any]:
    size = rules.image_size
    frames = {frame.name: frame for frame in capture.sequence.frames}
    missing = [name for name in (*draw.inputs, *draw.targets) if name not in frames]
    if missing:
        raise InputError(
            f"{draw.category}/{draw.sequence}: has no frame {missing[0]}, which the protocol names"
        )
    photographs = [frames[name].load() for name in draw.inputs]
    fine_size = size * _fine_scale(photographs, rules)
    inputs, seconds = _with_depth(photographs, rules.depth, fine_size)
    targets = [frames[name].load().squared(size) for name in draw.targets]
    cameras = stack_cameras([view.camera for view in targets])
    depths = [view.depth for view in inputs if view.depth is not None]
    warp = with_warp(query_batch(inputs, cameras, len(inputs), fine_size)[0], size).warp
    assert warp is not None
    pictures = {
        "inputs": torch.stack([view.image for view in inputs]),
        "truth": torch.stack([view.image for view in targets]),
        "warps": warp.image * warp.mask[:, None],
        "masks": warp.mask[:, None].expand(-1, 3, -1, -1),
    }
    contents = {
        f"{kind}/{i}.png": png_bytes(image)
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
    for name, content in contents.items():
        write_whole(folder / name, content)
    return {
        "format": FORMAT,
        "draw": asdict(draw),
        "image_size": size,
        "fine_size": fine_size,
        "depth_seconds": seconds,
        "cameras": {
            "inputs": [_camera_record(view.camera.resized(size, size)) for view in inputs],
            "targets": [_camera_record(view.camera) for view in targets],
        },
        "angles_rad": _angles_to_nearest([view.resized(size, size) for view in inputs], targets),
        "files": {name: hashlib.sha256(content).hexdigest() for name, content in contents.items()},
    }


def _fine_scale(photographs: ListOf[View], rules: RulesConfig) -> int:
    """What the rules say, but nothing is scaled up."""
    smallest = min(min(view.camera.height, view.camera.width) for view in photographs)
    return max(1, min(rules.fine_scale, smallest // rules.image_size))


def _with_depth(photographs: ListOf[View], depth_name: str, size: int) -> tuple[list[View], float]:
    """The inputs at a size with their depth, and how long finding it took.

    Depth is found at its source's own resolution, from the inputs alone.
    """
    source = depth_source(DEPTHS[depth_name])
    side = max(size, source.image_size or 0)
    large = [view.squared(side) for view in photographs]
    with Stopwatch() as watch:
        found = [depth.reliable() for depth in source.depth_maps(large)]
    views = []
    for view, depth in zip(large, found, strict=True):
        posed = View(view.image, view.camera, depth, name=view.name)
        views.append(posed.resized(size, size))
    return views, 0.0 if depth_name == "dataset" else watch.seconds


def _angles_to_nearest(inputs: ListOf[View], targets: ListOf[View]) -> list[float]:
    cameras = stack_cameras([view.camera for view in (*inputs, *targets)])
    angles = pairwise_angles(cameras, scene_center(cameras))
    return [float(a) for a in angles[len(inputs) :, : len(inputs)].min(1)]


def _camera_record(camera: Camera) -> dict[str, Any]:
    return {
        "world_to_cam": camera.world_to_cam.tolist(),
        "intrinsics": camera.intrinsics.tolist(),
    }


def png_bytes(image: Float[Tensor, "3 h w"]) -> bytes:
    """An image in [0, 1] as an 8-bit PNG."""
    content = io.BytesIO()
    Image.fromarray(to_eight_bits(image.permute(1, 2, 0))).save(content, "png")
    return content.getvalue()


def npy_bytes(values: Tensor) -> bytes:
    """An array in single precision."""
    content = io.BytesIO()
    np.save(content, values.float().numpy())
    return content.getvalue()


def _hash(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
