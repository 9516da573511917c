"""Checks that every reader shares."""

from collections.abc import Collection
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor

from extrap_train.errors import InputError
from extrap_train.views import Camera

ROTATION_TOLERANCE = 1e-3
"""Largest deviation of R Rᵀ from the identity; rotations stored as float32 stay below 1e-5."""

FOCAL_SIDES = (1e-3, 1e4)
"""Of focal lengths, in sides of the picture; a crop may be a small part of its photograph."""
CENTRE_SIDES = 1e3
"""How far outside of the picture the principal point of a crop may lie, in its sides."""


def is_degenerate(camera: Camera) -> Bool[Tensor, "*b"]:
    """Whether a camera is not finite, has no rotation, or a lens that no camera has."""
    rotation, intrinsics = camera.world_to_cam[..., :3, :3], camera.intrinsics
    finite = (camera.world_to_cam.sum((-2, -1)) + intrinsics.sum((-2, -1))).isfinite()
    deviation = (rotation @ rotation.mT - torch.eye(3, dtype=rotation.dtype)).abs().amax((-2, -1))
    right_handed = torch.linalg.det(rotation.nan_to_num()) > 0
    side = max(camera.height, camera.width)
    focal = intrinsics.diagonal(dim1=-2, dim2=-1)[..., :2] / side
    plausible = ((focal > FOCAL_SIDES[0]) & (focal < FOCAL_SIDES[1])).all(-1)
    centred = (intrinsics[..., :2, 2].abs() < CENTRE_SIDES * side).all(-1)
    return ~(finite & (deviation < ROTATION_TOLERANCE) & right_handed & plausible & centred)


def degenerate_camera(name: str, file: Path) -> str:
    """What to say of one that was read from `file`."""
    return (
        f"{file}: the camera of {name} is degenerate (NaN, no rotation, or a focal length or "
        "centre that fits no picture of its size); correct or remove its entry"
    )


def require_sound(cameras: Camera, names: Collection[str], file: Path) -> None:
    """Raise InputError that names the first degenerate camera of those read from `file`."""
    for name, degenerate in zip(names, is_degenerate(cameras).tolist(), strict=True):
        if degenerate:
            raise InputError(degenerate_camera(name, file))


def require_list(content: Any, what: str, file: Path) -> list[Any]:
    """`content`, if it is a list with something in it."""
    if not isinstance(content, list) or not content:
        raise InputError(
            f"{file}: expected {what} in a list, found {_kind(content)}; check the file"
        )
    return content


def require_dict(content: Any, what: str, file: Path) -> dict[str, Any]:
    """`content`, if it is a JSON object."""
    if not isinstance(content, dict):
        raise InputError(f"{file}: expected {what}, found {_kind(content)}; check the file")
    return content


def _kind(content: Any) -> str:
    return "an empty list" if content == [] else f"a {type(content).__name__}"
