"""CO3D downloads, first and second release, and everything else written in their layout.

Images, masks and depth maps are read when a frame is; what is read at once are the annotations of
one category. Depth is z in PyTorch3D's units, which are ours.
"""

import gc
import logging
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from extrap_train.data.annotations import (
    DepthFiles,
    FrameAnnotation,
    SequenceAnnotation,
    read_frame_annotations,
    read_sequence_annotations,
)
from extrap_train.data.co3d_cameras import cameras_of
from extrap_train.data.files import check_relative, read_json, resolve_inside
from extrap_train.data.images import (
    known_depth,
    read_depth_mask,
    read_image,
    read_mask,
    read_sixteen_bit,
)
from extrap_train.data.sequences import Frame, Sequence
from extrap_train.data.validation import require_dict
from extrap_train.errors import InputError, did_you_mean
from extrap_train.views import Camera, View

FRAME_ANNOTATIONS = "frame_annotations.jgz"
SEQUENCE_ANNOTATIONS = "sequence_annotations.jgz"

log = logging.getLogger(__name__)


class FrameId(NamedTuple):
    """An entry of a set list."""

    sequence: str
    number: int
    path: str


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

    def load(self) -> View:
        size = self.camera.height, self.camera.width
        mask_path = self.mask_path and resolve_inside(self.root, self.mask_path)
        return View(
            image=read_image(resolve_inside(self.root, self.image_path), size),
            camera=self.camera,
            depth=_read_depth(self.root, self.depth, size) if self.depth else None,
            mask=read_mask(mask_path, size) if mask_path else None,
            name=self.name,
        )


def list_categories(root: Path) -> list[str]:
    """The categories that a CO3D folder holds."""
    if not root.is_dir():
        raise InputError(f"{root}: no such folder; set data.root to the CO3D download")
    return sorted(file.parent.name for file in root.glob(f"*/{FRAME_ANNOTATIONS}"))


def read_category(root: Path, category: str) -> list[Sequence]:
    """All sequences of a category, by name; frames by number, those without a camera left out."""
    known = list_categories(root)
    if category not in known:
        present = ", ".join(known) or f"none (no folder in it has a {FRAME_ANNOTATIONS})"
        raise InputError(f"{root}: has no category {category!r}; categories present: {present}")
    file = root / category / FRAME_ANNOTATIONS
    with _collector_paused():
        details = read_sequence_annotations(root / category / SEQUENCE_ANNOTATIONS)
        posed = _posed_by_sequence(file)
        return [
            # Popped: what was parsed goes as soon as its sequence is made.
            _sequence(root, category, name, posed.pop(name), details.get(name), file)
            for name in sorted(posed)
        ]


@contextmanager
def _collector_paused() -> Iterator[None]:
    """Hold off the search for cycles: over millions of new objects it takes half the time."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


def _posed_by_sequence(file: Path) -> dict[str, list[FrameAnnotation]]:
    annotations = read_frame_annotations(file)
    posed: dict[str, list[FrameAnnotation]] = defaultdict(list)
    for annotation in annotations:
        if annotation.viewpoint is not None:
            posed[annotation.sequence].append(annotation)
    without_camera = len(annotations) - sum(map(len, posed.values()))
    if without_camera:
        log.warning("%s: %d frames have no camera and are left out", file, without_camera)
    if not posed:
        raise InputError(f"{file}: no frame has a camera; choose another category")
    return posed


def read_sequence(root: Path, category: str, name: str) -> Sequence:
    """One sequence of a category."""
    sequences = {sequence.name: sequence for sequence in read_category(root, category)}
    if name not in sequences:
        raise InputError(
            f"{root / category}: has no sequence {name!r}; {did_you_mean(name, sequences)}"
        )
    return sequences[name]


def read_set_list(root: Path, category: str, name: str) -> dict[str, list[FrameId]]:
    """The subsets (`train`, `val`, `test`) of a set list, e.g. `manyview_dev_0`."""
    file = root / category / "set_lists" / f"set_lists_{check_relative(name, root)}.json"
    content = require_dict(read_json(file), "an object with a list per subset", file)
    try:
        return {
            subset: [
                FrameId(str(sequence), int(number), check_relative(path, file))
                for sequence, number, path in entries
            ]
            for subset, entries in content.items()
        }
    except (TypeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(
            f"{file}: entries must be [sequence, frame number, path] ({error}); check the file"
        ) from None


def _sequence(
    root: Path,
    category: str,
    name: str,
    annotations: list[FrameAnnotation],
    details: SequenceAnnotation | None,
    file: Path,
) -> Sequence:
    annotations.sort(key=lambda annotation: annotation.number)
    if len({annotation.image_path for annotation in annotations}) != len(annotations):
        raise InputError(f"{file}: sequence {name} lists an image twice; remove the second entry")
    cloud = details.point_cloud_path if details else None
    return Sequence(
        category=category,
        name=name,
        frames=tuple(
            _frame(root, annotation, camera)
            for annotation, camera in zip(annotations, cameras_of(annotations, file), strict=True)
        ),
        viewpoint_quality=details.viewpoint_quality if details else None,
        point_cloud_quality=details.point_cloud_quality if details else None,
        point_cloud=root / cloud if cloud else None,
    )


def _frame(root: Path, annotation: FrameAnnotation, camera: Camera) -> Frame:
    photograph = _Photograph(
        root, annotation.image_path, annotation.depth, annotation.mask_path, camera
    )
    return Frame(
        name=photograph.name,
        camera=camera,
        has_depth=annotation.depth is not None,
        has_mask=annotation.mask_path is not None,
        load=photograph.load,
    )


def _read_depth(root: Path, files: DepthFiles, size: tuple[int, int]) -> torch.Tensor:
    path = resolve_inside(root, files.path)
    depth = known_depth(read_sixteen_bit(path, size).view(np.float16), files.scale, path)
    if files.mask_path:
        depth *= read_depth_mask(resolve_inside(root, files.mask_path), size)
    return depth
