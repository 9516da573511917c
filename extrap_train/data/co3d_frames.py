"""The frames of one CO3D sequence in a few arrays: a category has half a million of them."""

import os
from collections.abc import Iterable
from collections.abc import Sequence as ListOf
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import overload

import numpy as np
import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from extrap_train.data.annotations import DepthFiles, FrameAnnotation
from extrap_train.data.co3d_cameras import Cameras, cameras_of, frame_label
from extrap_train.data.images import (
    known_depth,
    read_depth_mask,
    read_photograph,
    read_sixteen_bit,
)
from extrap_train.data.paths import file_stamp, require_file
from extrap_train.data.sequences import Frame
from extrap_train.data.validation import degenerate_camera
from extrap_train.views import Camera, View

_JPEG_HEADER_BYTES, _BLACK_PIXELS_PER_BYTE = 1024, 32


@dataclass(frozen=True, slots=True)
class _Photograph:
    """One frame's files; a dataclass and no closure, so that worker processes can be sent it."""

    root: Path
    image_path: str
    depth: DepthFiles | None
    mask_path: str | None
    camera: Camera

    @property
    def name(self) -> str:
        return self.image_path.rpartition("/")[2]

    @property
    def files(self) -> tuple[Path, ...]:
        depth = (self.depth.path, self.depth.mask_path) if self.depth else ()
        return tuple(self.root / p for p in (self.image_path, self.mask_path, *depth) if p)

    def load(self, *, depth: bool = True) -> View:
        size = self.camera.height, self.camera.width
        mask_path = require_file(self.root / self.mask_path) if self.mask_path else None
        image_path = require_file(self.root / self.image_path)
        image, mask = read_photograph(image_path, size, mask_path)
        return View(
            image=image,
            camera=self.camera,
            depth=_read_depth(self.root, self.depth, size) if depth and self.depth else None,
            mask=mask,
            name=self.name,
        )


@dataclass(frozen=True, eq=False)
class Co3dFrames(ListOf[Frame]):
    """Some frames of one sequence; each is made when it is asked for.

    Columns with one row per frame, about 350 bytes instead of the 7,000 of as many small objects.
    Paths are the system's bytes, empty where there is no file.
    """

    root: Path
    number: Int[np.ndarray, " n"]
    size: Int[np.ndarray, "n 2"]
    """(height, width) in pixels."""
    world_to_cam: Float[np.ndarray, "n 4 4"]
    intrinsics: Float[np.ndarray, "n 3 3"]
    image_path: Shaped[np.ndarray, " n"]
    mask_path: Shaped[np.ndarray, " n"]
    depth_path: Shaped[np.ndarray, " n"]
    depth_mask_path: Shaped[np.ndarray, " n"]
    depth_scale: Float[np.ndarray, " n"]

    @classmethod
    def of(
        cls, root: Path, annotations: list[FrameAnnotation], file: Path
    ) -> tuple["Co3dFrames", tuple[str, ...]]:
        """In the annotations' order, and why some are left out: their camera is degenerate."""
        cameras = cameras_of(annotations)
        frames = cls._of(root, annotations, cameras)
        if cameras.sound.all():
            return frames, ()
        unsound = [annotations[i] for i in np.flatnonzero(~cameras.sound)]
        reasons = tuple(degenerate_camera(frame_label(frame), file) for frame in unsound)
        return frames._taken(cameras.sound), reasons

    @classmethod
    def _of(cls, root: Path, annotations: list[FrameAnnotation], cameras: Cameras) -> "Co3dFrames":
        depths = [annotation.depth for annotation in annotations]
        return cls(
            root=root,
            number=np.array([annotation.number for annotation in annotations], np.int64),
            size=np.array([annotation.size for annotation in annotations], np.int32),
            world_to_cam=cameras.world_to_cam,
            intrinsics=cameras.intrinsics,
            image_path=_encoded(annotation.image_path for annotation in annotations),
            mask_path=_encoded(annotation.mask_path for annotation in annotations),
            depth_path=_encoded(depth.path if depth else None for depth in depths),
            depth_mask_path=_encoded(depth.mask_path if depth else None for depth in depths),
            depth_scale=np.array([depth.scale if depth else 0.0 for depth in depths]),
        )

    @classmethod
    def joined(cls, parts: ListOf["Co3dFrames"]) -> "Co3dFrames":
        """All frames of the parts, by number."""
        columns = {
            name: np.concatenate([getattr(part, name) for part in parts]) for name in cls._columns()
        }
        together = cls(root=parts[0].root, **columns)
        return together._taken(np.argsort(together.number, kind="stable"))

    @classmethod
    def _columns(cls) -> list[str]:
        return [field.name for field in fields(cls) if field.name != "root"]

    def _taken(self, rows: Shaped[np.ndarray, " m"]) -> "Co3dFrames":
        """These rows alone, by their indices or a mask."""
        return replace(self, **{name: getattr(self, name)[rows] for name in self._columns()})

    @property
    def has_duplicates(self) -> bool:
        """Whether a photograph is listed twice."""
        return len(np.unique(self.image_path)) < len(self)

    def __len__(self) -> int:
        return len(self.number)

    @overload
    def __getitem__(self, index: int) -> Frame: ...

    @overload
    def __getitem__(self, index: slice) -> tuple[Frame, ...]: ...

    def __getitem__(self, index: int | slice) -> Frame | tuple[Frame, ...]:
        if isinstance(index, slice):
            return tuple(self._frame(i) for i in range(*index.indices(len(self))))
        return self._frame(index)

    def _frame(self, index: int) -> Frame:
        height, width = self.size[index].tolist()
        # Copied: a frame that is sent to another process must not take its whole sequence along.
        camera = Camera(
            torch.tensor(self.world_to_cam[index]),
            torch.tensor(self.intrinsics[index]),
            height,
            width,
        )
        photograph = _Photograph(
            self.root,
            os.fsdecode(self.image_path[index]),
            self._depth(index),
            os.fsdecode(self.mask_path[index]) or None,
            camera,
        )
        return Frame(
            name=photograph.name,
            camera=camera,
            has_depth=photograph.depth is not None,
            has_mask=photograph.mask_path is not None,
            load=photograph.load,
            files=photograph.files,
            reading=f"depth in {self.depth_scale[index]}",
        )

    def _depth(self, index: int) -> DepthFiles | None:
        if not self.depth_path[index]:
            return None
        return DepthFiles(
            os.fsdecode(self.depth_path[index]),
            float(self.depth_scale[index]),
            os.fsdecode(self.depth_mask_path[index]) or None,
        )


def is_blackened(root: Path, annotation: FrameAnnotation) -> bool:
    """Whether a frame is a hidden target of CO3D's challenge: black, with the true camera.

    Those of later releases and of the development sets are photographs. A black JPEG takes a
    64th of a byte per pixel, a photograph a tenth at least, so that none has to be decoded.
    """
    if not annotation.is_challenge_target:
        return False
    stamp = file_stamp(root / annotation.image_path)
    height, width = annotation.size
    return stamp is None or stamp[0] < _JPEG_HEADER_BYTES + height * width / _BLACK_PIXELS_PER_BYTE


def _encoded(paths: Iterable[str | None]) -> Shaped[np.ndarray, " n"]:
    return np.array([os.fsencode(path or "") for path in paths])


def _read_depth(root: Path, files: DepthFiles, size: tuple[int, int]) -> Float[Tensor, "h w"]:
    path = require_file(root / files.path)
    depth = known_depth(read_sixteen_bit(path, size).view(np.float16), files.scale, path)
    if files.mask_path:
        depth *= read_depth_mask(require_file(root / files.mask_path), size)
    return depth
