"""The frames of one CO3D sequence in a few arrays: a category has half a million of them."""

import math
import os
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast, overload

import numpy as np
import torch
from jaxtyping import Bool, Shaped

from extrap_train.data.camera_check import degenerate_camera, is_degenerate
from extrap_train.data.co3d.annotations import VIEWPOINT, FrameAnnotation
from extrap_train.data.depth_files import DepthFile
from extrap_train.data.paths import file_stamp
from extrap_train.data.sequences import Frame, Photograph
from extrap_train.geometry.foreign_cameras import NdcFormat, Viewpoint, camera_from_viewpoint
from extrap_train.views import Camera

_JPEG_HEADER_BYTES, _BLACK_PIXELS_PER_BYTE = 1024, 32


@dataclass(frozen=True, eq=False)
class Co3dFrames(Sequence[Frame]):
    """Some frames of one sequence; each is made when it is asked for.

    A table with one row per frame, about 350 bytes instead of the 7,000 of as many small objects.
    Paths are the system's bytes, empty where there is no file.
    """

    root: Path
    table: Shaped[np.ndarray, " n"]

    @classmethod
    def of(
        cls, root: Path, annotations: list[FrameAnnotation], file: Path
    ) -> tuple["Co3dFrames", tuple[str, ...]]:
        """In the annotations' order, and why some are left out: their camera is degenerate."""
        cameras, sound = _convert_cameras(annotations)
        depths = [annotation.depth for annotation in annotations]
        columns: dict[str, np.ndarray] = {
            "number": np.array([annotation.number for annotation in annotations], np.int64),
            "size": np.array([annotation.size for annotation in annotations], np.int32),
            **cameras,
            "image_path": _encode(annotation.image_path for annotation in annotations),
            "mask_path": _encode(annotation.mask_path for annotation in annotations),
            "depth_path": _encode(depth.path if depth else None for depth in depths),
            "depth_mask_path": _encode(depth.mask_path if depth else None for depth in depths),
            "depth_scale": np.array([depth.scale if depth else 0.0 for depth in depths]),
        }
        kinds = [(name, column.dtype, column.shape[1:]) for name, column in columns.items()]
        table = np.empty(len(annotations), kinds)
        for name, column in columns.items():
            table[name] = column
        unsound = [annotations[i] for i in np.flatnonzero(~sound)]
        reasons = tuple(
            degenerate_camera(f"{frame.sequence} frame {frame.number}", file) for frame in unsound
        )
        return cls(root, table[sound]), reasons

    @classmethod
    def join(cls, parts: Sequence["Co3dFrames"]) -> "Co3dFrames":
        """All frames of the parts, by number."""
        table = np.concatenate([part.table for part in parts])
        return cls(parts[0].root, table[np.argsort(table["number"], kind="stable")])

    def without_duplicates(self, file: Path) -> tuple["Co3dFrames", tuple[str, ...]]:
        """Each photograph once, and why some are left out: their entries contradict each other.

        Equal entries, whatever their number, are one frame.
        """
        paths, first, place = np.unique(
            self.table["image_path"], return_index=True, return_inverse=True
        )
        if len(paths) == len(self):
            return self, ()
        agrees = np.ones(len(self), bool)
        for name in set(self.table.dtype.names or ()) - {"number"}:
            column = self.table[name]
            agrees &= (column == column[first][place]).reshape(len(self), -1).all(1)
        contradictory = np.unique(place[~agrees])
        reasons = tuple(
            f"{file}: lists {os.fsdecode(paths[i])} twice, with different cameras or files; remove "
            "the wrong entry"
            for i in contradictory
        )
        return replace(self, table=self.table[np.sort(np.delete(first, contradictory))]), reasons

    def __len__(self) -> int:
        return len(self.table)

    @overload
    def __getitem__(self, index: int) -> Frame: ...

    @overload
    def __getitem__(self, index: slice) -> tuple[Frame, ...]: ...

    def __getitem__(self, index: int | slice) -> Frame | tuple[Frame, ...]:
        if isinstance(index, slice):
            return tuple(self._frame(i) for i in range(*index.indices(len(self))))
        return self._frame(index)

    def _frame(self, index: int) -> Frame:
        row = self.table[index]
        height, width = row["size"].tolist()
        # Copied: a frame that is sent to another process must not take its whole sequence along.
        camera = Camera(
            torch.tensor(row["world_to_cam"]), torch.tensor(row["intrinsics"]), height, width
        )
        image, mask, depth, depth_mask = (
            os.fsdecode(row[f"{kind}_path"]) for kind in ("image", "mask", "depth", "depth_mask")
        )
        scale = float(row["depth_scale"])
        return Photograph(
            root=self.root,
            name=image.rpartition("/")[2],
            camera=camera,
            image_path=image,
            mask=self.root / mask if mask else None,
            depth=DepthFile(depth, scale, depth_mask or None, True) if depth else None,
        ).frame()


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


def _encode(paths: Iterable[str | None]) -> Shaped[np.ndarray, " n"]:
    return np.array([os.fsencode(path or "") for path in paths])


def _convert_cameras(
    annotations: list[FrameAnnotation],
) -> tuple[dict[str, Shaped[np.ndarray, "n ..."]], Bool[np.ndarray, " n"]]:
    """World-to-camera and intrinsics of each frame, and whether they are sound.

    They are converted together where size and format agree: one by one is slow.
    """
    groups: dict[tuple[tuple[int, int], str], list[int]] = defaultdict(list)
    for index, annotation in enumerate(annotations):
        groups[annotation.size, annotation.intrinsics_format].append(index)
    count = len(annotations)
    world_to_cam = np.empty((count, 4, 4), np.float32)
    intrinsics = np.empty((count, 3, 3), np.float32)
    sound = np.empty(count, bool)
    for ((height, width), ndc), members in groups.items():
        batch = _convert_batch([annotations[i] for i in members], height, width, ndc)
        world_to_cam[members] = batch.world_to_cam.numpy()
        intrinsics[members] = batch.intrinsics.numpy()
        sound[members] = ~is_degenerate(batch).numpy()
    return {"world_to_cam": world_to_cam, "intrinsics": intrinsics}, sound


def _convert_batch(annotations: list[FrameAnnotation], height: int, width: int, ndc: str) -> Camera:
    """In single precision, as it is used: what is finite in double may be none there."""
    numbers = torch.tensor(
        [annotation.viewpoint for annotation in annotations], dtype=torch.float64
    )
    sizes = [math.prod(shape) for shape in VIEWPOINT.values()]
    rotation, translation, focal_length, principal_point = numbers.split(sizes, dim=1)
    camera = camera_from_viewpoint(
        Viewpoint(
            rotation=rotation.reshape(-1, 3, 3),
            translation=translation,
            focal_length=focal_length,
            principal_point=principal_point,
            intrinsics_format=cast(NdcFormat, ndc),
        ),
        height,
        width,
    )
    return replace(
        camera, world_to_cam=camera.world_to_cam.float(), intrinsics=camera.intrinsics.float()
    )
