"""CO3D's annotated viewpoints to cameras, and which of them are sound."""

import math
from collections import defaultdict
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
import torch
from jaxtyping import Bool, Float

from extrap_train.data.annotations import VIEWPOINT, FrameAnnotation
from extrap_train.data.validation import is_degenerate
from extrap_train.geometry.pytorch3d import NdcFormat, Viewpoint, camera_from_viewpoint
from extrap_train.views import Camera


@dataclass(frozen=True)
class Cameras:
    """One row per frame; those that are not sound must not be used."""

    world_to_cam: Float[np.ndarray, "n 4 4"]
    intrinsics: Float[np.ndarray, "n 3 3"]
    sound: Bool[np.ndarray, " n"]


def cameras_of(annotations: list[FrameAnnotation]) -> Cameras:
    """One camera per frame, converted together where size and format agree (one by one is slow)."""
    groups: dict[tuple[tuple[int, int], str], list[int]] = defaultdict(list)
    for index, annotation in enumerate(annotations):
        groups[annotation.size, annotation.intrinsics_format].append(index)
    count = len(annotations)
    world_to_cam = np.empty((count, 4, 4), np.float32)
    intrinsics = np.empty((count, 3, 3), np.float32)
    sound = np.empty(count, bool)
    for ((height, width), ndc), members in groups.items():
        batch = _converted([annotations[i] for i in members], height, width, ndc)
        world_to_cam[members] = batch.world_to_cam.numpy()
        intrinsics[members] = batch.intrinsics.numpy()
        sound[members] = ~is_degenerate(batch).numpy()
    return Cameras(world_to_cam, intrinsics, sound)


def frame_label(annotation: FrameAnnotation) -> str:
    """What a message calls a frame."""
    return f"{annotation.sequence} frame {annotation.number}"


def _converted(annotations: list[FrameAnnotation], height: int, width: int, ndc: str) -> Camera:
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
