"""One draw on disk: what a method receives, and apart from it what its images are scored against.

<folder>/scene.json            the draw, cameras, angles, hashes; written last
         inputs/0.png …        inputs/depth.npy (0 = unknown; found from the inputs alone), at
                               the finer size
         truth/0.png …         truth/depth.npy, truth/object.npy and truth/surroundings.npy (points)
                               where the capture knows them
         warps/0.png …         masks/0.png …: the fused warp of all inputs, and what it reaches
"""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.methods.base import SceneInputs
from benchmarks.protocol import Draw, digest, draw_of
from benchmarks.recorded_depth import RecordedDepth
from extrap_train.data.images import read_image
from extrap_train.data.json_files import read_json
from extrap_train.errors import InputError
from extrap_train.views import Camera, View

FORMAT = 2


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


def _hash(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
