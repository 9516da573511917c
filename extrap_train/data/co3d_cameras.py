"""CO3D's annotated viewpoints to cameras, and which of them are sound."""

from collections import defaultdict
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from extrap_train.data.annotations import FrameAnnotation
from extrap_train.data.validation import is_degenerate
from extrap_train.errors import InputError
from extrap_train.geometry.pytorch3d import NdcFormat, Viewpoint, camera_from_viewpoint
from extrap_train.views import Camera


@dataclass(frozen=True)
class Cameras:
    """A row a frame; what is not sound is not to be used."""

    world_to_cam: Float[np.ndarray, "n 4 4"]
    intrinsics: Float[np.ndarray, "n 3 3"]
    sound: Bool[np.ndarray, " n"]


def cameras_of(annotations: list[FrameAnnotation], file: Path) -> Cameras:
    """A camera a frame, converted together where size and format agree (one by one is slow)."""
    groups: dict[tuple[tuple[int, int], str], list[int]] = defaultdict(list)
    for index, annotation in enumerate(annotations):
        groups[annotation.size, annotation.intrinsics_format].append(index)
    count = len(annotations)
    world_to_cam = np.empty((count, 4, 4), np.float32)
    intrinsics = np.empty((count, 3, 3), np.float32)
    sound = np.empty(count, bool)
    for ((height, width), ndc), members in groups.items():
        batch = _converted([annotations[i] for i in members], height, width, ndc, file)
        world_to_cam[members] = batch.world_to_cam.numpy()
        intrinsics[members] = batch.intrinsics.numpy()
        sound[members] = ~is_degenerate(batch).numpy()
    return Cameras(world_to_cam, intrinsics, sound)


def frame_label(annotation: FrameAnnotation) -> str:
    """What a message calls a frame."""
    return f"{annotation.sequence} frame {annotation.number}"


def _converted(
    annotations: list[FrameAnnotation], height: int, width: int, ndc: str, file: Path
) -> Camera:
    """In single precision, as it is used: what is finite in double may be none there."""
    viewpoints = [cast(dict[str, Any], annotation.viewpoint) for annotation in annotations]
    ends = frame_label(annotations[0]), frame_label(annotations[-1])
    camera = camera_from_viewpoint(
        Viewpoint(
            rotation=_stack(viewpoints, "R", (3, 3), ends, file),
            translation=_stack(viewpoints, "T", (3,), ends, file),
            focal_length=_stack(viewpoints, "focal_length", (2,), ends, file),
            principal_point=_stack(viewpoints, "principal_point", (2,), ends, file),
            intrinsics_format=cast(NdcFormat, ndc),
        ),
        height,
        width,
    )
    return replace(
        camera, world_to_cam=camera.world_to_cam.float(), intrinsics=camera.intrinsics.float()
    )


def _stack(
    viewpoints: list[dict[str, Any]],
    key: str,
    shape: tuple[int, ...],
    ends: tuple[str, str],
    file: Path,
) -> Float[Tensor, "n ..."]:
    try:
        values = np.array([viewpoint[key] for viewpoint in viewpoints], dtype=np.float64)
    except (KeyError, TypeError, ValueError, OverflowError):
        values = np.empty(0)
    if values.shape != (len(viewpoints), *shape):
        expected = " x ".join(map(str, shape))
        raise InputError(
            f"{file}: a viewpoint from {ends[0]} to {ends[1]} has no {key} of {expected} "
            "numbers; correct the entry"
        )
    return torch.from_numpy(values)
