"""CO3D's annotated viewpoints to cameras, checked."""

from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.data.annotations import FrameAnnotation
from extrap_train.data.validation import require_sound
from extrap_train.errors import InputError
from extrap_train.geometry.pytorch3d import NdcFormat, Viewpoint, camera_from_viewpoint
from extrap_train.views import Camera


def cameras_of(annotations: list[FrameAnnotation], file: Path) -> list[Camera]:
    """A camera a frame, converted together where size and format agree (one by one is slow)."""
    groups: dict[tuple[tuple[int, int], str], list[int]] = defaultdict(list)
    for index, annotation in enumerate(annotations):
        groups[annotation.size, annotation.intrinsics_format].append(index)
    cameras: dict[int, Camera] = {}
    for ((height, width), ndc), members in groups.items():
        names = [f"{annotations[i].sequence} frame {annotations[i].number}" for i in members]
        viewpoints = [cast(dict[str, Any], annotations[i].viewpoint) for i in members]
        batch = camera_from_viewpoint(
            Viewpoint(
                rotation=_stack(viewpoints, "R", (3, 3), names, file),
                translation=_stack(viewpoints, "T", (3,), names, file),
                focal_length=_stack(viewpoints, "focal_length", (2,), names, file),
                principal_point=_stack(viewpoints, "principal_point", (2,), names, file),
                intrinsics_format=cast(NdcFormat, ndc),
            ),
            height,
            width,
        )
        batch = replace(
            batch, world_to_cam=batch.world_to_cam.float(), intrinsics=batch.intrinsics.float()
        )
        require_sound(batch, names, file)  # as it is used: what is finite in double may be none
        matrices = zip(members, batch.world_to_cam, batch.intrinsics, strict=True)
        for index, world_to_cam, intrinsics in matrices:
            cameras[index] = Camera(world_to_cam, intrinsics, height, width)
    return [cameras[index] for index in range(len(annotations))]


def _stack(
    viewpoints: list[dict[str, Any]],
    key: str,
    shape: tuple[int, ...],
    names: list[str],
    file: Path,
) -> Float[Tensor, "n ..."]:
    try:
        values = np.array([viewpoint[key] for viewpoint in viewpoints], dtype=np.float64)
    except (KeyError, TypeError, ValueError, OverflowError):
        values = np.empty(0)
    if values.shape != (len(viewpoints), *shape):
        expected = " x ".join(map(str, shape))
        raise InputError(
            f"{file}: a viewpoint from {names[0]} to {names[-1]} has no {key} of {expected} "
            "numbers; correct the entry"
        )
    return torch.from_numpy(values)
