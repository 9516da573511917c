"""One draw on disk: what a method receives, and apart from it what its images are scored against.

scenes/DRAW/scene.json      the draw, cameras, angles, hashes; written last
            inputs/0.png …  inputs/depth.npy (0 = unknown; found from the inputs alone), at the
                            finer size
truths/DRAW/truth/0.png …   truth/depth.npy, truth/object.npy and truth/surroundings.npy (points)
                            where the capture knows them
            warps/0.png …   masks/0.png …: the fused warp of all inputs, and what it reaches

While methods run, `truths` is not there (`truths_removed`).
"""

import shutil
import tarfile
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from benchmarks.methods.base import SceneInputs
from benchmarks.protocol.array_files import (
    InnerPath,
    Number,
    Positive,
    array_of,
    pictures_of,
    read_limited,
    sha256_of,
)
from benchmarks.protocol.draws import Draw
from extrap_train.depth import DatasetDepth, DepthMap
from extrap_train.errors import InputError
from extrap_train.store.atomic import atomic_folder
from extrap_train.store.digests import json_digest
from extrap_train.store.records import read_record
from extrap_train.views import Camera, View

SCENE_FORMAT: Literal[4] = 4

INPUTS = "inputs/"
"""What the names of files begin with that methods receive; all others are the truth's."""


Three, Four = Field(min_length=3, max_length=3), Field(min_length=4, max_length=4)
Side = Annotated[int, Field(ge=1, le=8192)]


@dataclass(frozen=True)
class CameraRecord:
    """One camera of a scene."""

    world_to_cam: Annotated[list[Annotated[list[Number], Four]], Four]
    intrinsics: Annotated[list[Annotated[list[Number], Three]], Three]


@dataclass(frozen=True)
class SceneRecord:
    """A prepared draw, `scene.json`."""

    format: Literal[4]
    origin: str
    """Digest of all that decides the content."""
    draw: Draw
    image_size: Side
    fine_size: Side
    depth_seconds: Positive
    inputs: list[CameraRecord]
    """At the targets' size."""
    targets: list[CameraRecord]
    angles_rad: list[Number]
    """From each target to its nearest input."""
    files: dict[InnerPath, str]
    """SHA-256 by file, the truth's included."""


@dataclass(frozen=True)
class TrueSurface:
    """Points of what a capture shows, in world units."""

    object: Float[Tensor, "m 3"]
    surroundings: Float[Tensor, "k 3"]
    """Ground and the like: not asked for, and no error."""


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
    record: SceneRecord

    @classmethod
    def open(cls, folder: Path) -> "Scene":
        """A prepared draw; raises InputError where its record is missing or damaged."""
        file = folder / "scene.json"
        remedy = f"delete {folder} and run the table again"
        record = read_record(file, SceneRecord, remedy)
        draw = record.draw
        views = (len(record.inputs), len(record.targets), len(record.angles_rad))
        if views != (len(draw.inputs), len(draw.targets), len(draw.targets)) or 0 in views:
            raise InputError(f"{file}: has other numbers of cameras than of frames; {remedy}")
        needed = {*_pictures("inputs", draw.inputs), "inputs/depth.npy"}
        needed |= {n for kind in ("truth", "warps", "masks") for n in _pictures(kind, draw.targets)}
        if missing := needed - record.files.keys():
            raise InputError(f"{file}: names no {min(missing)}; {remedy}")
        return cls(folder, record)

    @property
    def draw(self) -> Draw:
        """Which frames of which capture it holds."""
        return self.record.draw

    @property
    def data_hash(self) -> str:
        """Hash of every file and camera in the scene."""
        kept = asdict(self.record)
        return json_digest([kept[part] for part in ("draw", "inputs", "targets", "files")])

    @property
    def truth_folder(self) -> Path:
        """Where the truth lies, except while methods run."""
        return truths_of(self.folder.parent) / self.folder.name

    def file(self, name: str) -> Path:
        """Where one of its files lies."""
        return (self.folder if name.startswith(INPUTS) else self.truth_folder) / name

    def changed_files(self) -> list[str]:
        """Files that are missing, or not what their hash says."""
        return [
            name
            for name, stated in self.record.files.items()
            if sha256_of(self.file(name)) != stated
        ]

    def inputs(self) -> SceneInputs:
        """What a method receives; nothing of the truth is read."""
        draw, record = self.draw, self.record
        cameras = _camera(record.inputs, record.image_size)
        side, size = record.fine_size, record.image_size
        images = self._pictures("inputs", draw.inputs, side)
        depths = self._array("inputs/depth.npy", (len(draw.inputs), side, side))
        assert depths is not None
        fine = [
            View(image, cameras[i].resized(side, side), depths[i], name=draw.inputs[i])
            for i, image in enumerate(images)
        ]
        return SceneInputs(
            category=draw.category,
            views=tuple(view.resized(size, size) for view in fine),
            targets=self.target_cameras,
            depth_source=RecordedDepth(record.depth_seconds),
            seed=draw.seed,
            fine_views=tuple(fine),
        )

    @property
    def target_cameras(self) -> Camera:
        """Where views are to be made."""
        return _camera(self.record.targets, self.record.image_size)

    def truth(self) -> Truth:
        """What the images are scored against."""
        frames, size = self.draw.targets, self.record.image_size
        return Truth(
            images=self._pictures("truth", frames, size),
            cameras=self.target_cameras,
            warps=self._pictures("warps", frames, size),
            masks=(self._pictures("masks", frames, size)[:, 0] > 0.5).float(),
            depths=self._array("truth/depth.npy", (len(frames), size, size)),
            surface=self._surface(),
        )

    def _surface(self) -> TrueSurface | None:
        found = [self._array(f"truth/{kind}.npy", (None, 3)) for kind in ("object", "surroundings")]
        return None if found[0] is None or found[1] is None else TrueSurface(found[0], found[1])

    def _pictures(
        self, kind: str, frames: tuple[str, ...], side: int
    ) -> Float[Tensor, "n 3 side side"]:
        files = map(self.file, _pictures(kind, frames))
        return pictures_of({file: read_limited(file) for file in files}, side).contiguous()

    def _array(self, name: str, shape: tuple[int | None, ...]) -> Tensor | None:
        file = self.file(name)
        return array_of(read_limited(file), shape, file) if name in self.record.files else None


@dataclass(frozen=True)
class RecordedDepth(DatasetDepth):
    """Depth that the views carry, found once for all methods and charged to each that asks.

    InputError for a view that is none of the inputs.
    """

    took_seconds: float
    asked: list[bool] = field(default_factory=list)

    @property
    def seconds(self) -> float:
        """0 until the first question, then what the source took."""
        return self.took_seconds if self.asked else 0.0

    def depth_map(self, view: View, neighbours: Sequence[View]) -> DepthMap:
        """An input's depth."""
        self.asked.append(True)
        return super().depth_map(view, neighbours)


@contextmanager
def truths_removed(truths: Path) -> Iterator[None]:
    """Remove a folder of truths, and put it back at the end of the block, however that ends.

    Meanwhile they lie in a file that has no name and is open in this process alone. Where this
    process is killed they are gone, and the next run prepares them again.
    """
    with tempfile.TemporaryFile(dir=truths.parent) as kept:
        with tarfile.open(fileobj=kept, mode="w") as archive:
            archive.add(truths, arcname="")
        shutil.rmtree(truths)
        try:
            yield
        finally:
            kept.seek(0)
            with tarfile.open(fileobj=kept) as archive, atomic_folder(truths) as made:
                archive.extractall(made, filter="data")


def truths_of(scenes: Path) -> Path:
    """The folder of the truths of a folder of scenes."""
    return scenes.with_name("truths")


def _pictures(kind: str, frames: tuple[str, ...]) -> list[str]:
    return [f"{kind}/{index}.png" for index in range(len(frames))]


def _camera(entries: list[CameraRecord], size: int) -> Camera:
    return Camera(
        torch.tensor([entry.world_to_cam for entry in entries]),
        torch.tensor([entry.intrinsics for entry in entries]),
        size,
        size,
    )
