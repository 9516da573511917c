"""Whether cameras are sound, and whether those of a capture can see something in common.

Every capture passes the second check when it is opened, whatever the task. Poses in another
convention look sound one by one; together they stand in one place, or look away from each other.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import roma
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from extrap_train.errors import InputError
from extrap_train.geometry.foreign_cameras import (
    colmap_from_world_to_cam,
    flip_up_and_forward,
    opengl_from_world_to_cam,
    rigid_inverse,
    world_to_cam_from_colmap,
)
from extrap_train.geometry.viewpoints import (
    LOOKS_AT_RAD,
    camera_centers,
    directions_from,
    scene_center,
)
from extrap_train.views import Camera

PARALLEL_RAD = np.deg2rad(15)
"""Cameras whose axes differ by less from their mean look the same way, and need no common point."""
WIDE_RAD = np.deg2rad(20)
"""Axes that differ by more prove that cameras stand around what they look at."""
MIN_APART = 1e-4
"""Least distance between cameras, as a share of their distance from the origin: below it single
precision blurs their places."""
ONE_PLACE = 1e-6
"""In scene units."""
MIN_SHARE, NEARLY_ALL = 1 / 3, 0.9
"""Shares of cameras that look at one point: too few below the first, enough from the second on to
name a convention."""
SAME_FIT_RAD = np.deg2rad(0.5)
"""Conventions between which the axes' distance from one point differs by less are both named."""
CLEARLY_RAD = np.deg2rad(5)
"""Another convention fits only if the axes miss one point by more than this angle plus twice what
they miss it by under that convention."""

ROTATION_TOLERANCE = 1e-3
"""Largest deviation of R Rᵀ from the identity; rotations stored as float32 stay below 1e-5."""

FOCAL_SIDES = (1e-3, 1e4)
"""Range of focal lengths, in sides of the picture; a crop may be a small part of its photograph."""
CENTRE_SIDES = 1e3
"""How far outside of the picture the principal point of a crop may lie, in its sides."""

SHORTEST_FOCAL, LONGEST_FOCAL = 0.2, 20.0
"""Range of a photograph's focal length: the shortest in its shorter side, which a circular fisheye
fills, the longest in its longer one."""
MAX_OFFSET = 0.25
"""Largest offset of a principal point from the photograph's middle, as a share of each side."""
NORMALISED_FOCAL = 5.0
"""Focal length in pixels below which it must be given in widths of the picture."""


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


def fits_photograph(camera: Camera) -> Bool[Tensor, "*b"]:
    """Whether a camera is sound, with a lens that fits a whole photograph of its size."""
    size = camera.intrinsics.new_tensor([camera.width, camera.height])
    focal = camera.intrinsics.diagonal(dim1=-2, dim2=-1)[..., :2]
    fits = (focal >= SHORTEST_FOCAL * size.min()) & (focal <= LONGEST_FOCAL * size.max())
    centred = (camera.intrinsics[..., :2, 2] / size - 0.5).abs() <= MAX_OFFSET
    return ~is_degenerate(camera) & (fits & centred).all(-1)


def _lens_fault(camera: Camera) -> str:
    """What to say of a sound camera whose lens fits no photograph of its size."""
    (fx, _, cx), (_, fy, cy), _ = camera.intrinsics.tolist()
    if min(fx, fy) < NORMALISED_FOCAL or (0 < cx <= 1 and 0 < cy <= 1):
        cause = "they look normalised: multiply fx and cx by the width, fy and cy by the height"
    else:
        cause = (
            "are they those of another size, or is an angle in another unit (camera_angle_x is in "
            "radians, x_fov in degrees)? Correct them"
        )
    return (
        f"intrinsics (fx {fx:.4g}, fy {fy:.4g}, cx {cx:.4g}, cy {cy:.4g} pixels) do not fit a "
        f"picture of {camera.width} x {camera.height} pixels; {cause}"
    )


_DEGENERATE = "NaN, no rotation, or a focal length or centre that fits no picture of its size"


def degenerate_camera(name: str, file: Path, why: str = _DEGENERATE) -> str:
    """What to say of one that was read from `file`."""
    return f"{file}: the camera of {name} is degenerate ({why}); correct or remove its entry"


def _degeneracy(camera: Camera) -> str:
    """Why a degenerate camera is one; it is not batched."""
    rotation = camera.world_to_cam[:3, :3].double()
    off = float((rotation @ rotation.mT - torch.eye(3).double()).abs().max())
    if not (camera.world_to_cam.isfinite().all() and camera.intrinsics.isfinite().all()):
        return "NaN or infinite"
    if off >= ROTATION_TOLERANCE:
        return (
            f"its axes are no rotation, R Rᵀ being off by {off:.2g}: are they rounded, or scaled "
            "unevenly?"
        )
    if torch.linalg.det(rotation) < 0:
        return "its axes are mirrored, left-handed: was one axis of the world flipped?"
    return "a focal length or centre that fits no picture of its size"


def require_sound(camera: Camera, name: str, file: Path) -> None:
    """Raise InputError where the camera of a photograph, read from `file`, cannot be used."""
    if is_degenerate(camera):
        raise InputError(degenerate_camera(name, file, _degeneracy(camera)))
    if not fits_photograph(camera):
        raise InputError(f"{file}: {name}: {_lens_fault(camera)}")


Reread = Callable[[Float[Tensor, "n 4 4"]], Float[Tensor, "n 4 4"]]


@dataclass(frozen=True)
class PoseConvention:
    """What the poses of a file are, and what else people put there."""

    name: str
    mistakes: Mapping[str, Reread] = field(default_factory=dict)
    """What they may be instead, each with what makes the `world_to_cam` that was read right."""


ROLLED = "quaternions in the order x, y, z, w"
TRANSPOSED = "PyTorch3D's with R transposed, for column vectors"


def quaternions_rolled(read: Float[Tensor, "*n 4 4"]) -> Float[Tensor, "*n 4 4"]:
    """Poses whose quaternions w, x, y, z were read are x, y, z, w."""
    wxyz, translation = colmap_from_world_to_cam(read)
    return world_to_cam_from_colmap(wxyz.roll(1, dims=-1), translation)


def rotations_transposed(read: Float[Tensor, "*n 4 4"]) -> Float[Tensor, "*n 4 4"]:
    """Poses of which PyTorch3D's R was read is its transpose."""
    right = read.clone()
    flip = read.new_tensor([-1.0, -1.0, 1.0])
    right[..., :3, :3] = flip[:, None] * read[..., :3, :3].mT * flip
    return right


def _placed(
    rotation: Float[Tensor, "*n 3 3"], translation: Float[Tensor, "*n 3"]
) -> Float[Tensor, "*n 4 4"]:
    return roma.Rigid(rotation, translation).to_homogeneous()


OPENGL_POSES = PoseConvention(
    "camera-to-world in OpenGL's axes (+X right, +Y up, −Z forward)",
    {
        "camera-to-world in OpenCV's axes (+Y down, +Z forward)": lambda read: rigid_inverse(
            opengl_from_world_to_cam(read)
        ),
        "world-to-camera in OpenCV's axes, as COLMAP has them": opengl_from_world_to_cam,
        "world-to-camera in OpenGL's axes": lambda read: rigid_inverse(
            flip_up_and_forward(rigid_inverse(opengl_from_world_to_cam(read)))
        ),
    },
)
COLMAP_POSES = PoseConvention(
    "world-to-camera, as COLMAP writes them",
    {
        "camera-to-world": rigid_inverse,
        ROLLED: quaternions_rolled,
        "world-to-camera with R transposed": lambda read: _placed(
            read[..., :3, :3].mT, read[..., :3, 3]
        ),
        "world-to-camera rotations beside the cameras' positions": lambda read: _placed(
            read[..., :3, :3], -(read[..., :3, :3] @ read[..., :3, 3:])[..., 0]
        ),
        "world-to-camera in OpenGL's axes (+Y up, −Z forward)": lambda read: (
            read * read.new_tensor([1.0, -1.0, -1.0, 1.0])[:, None]
        ),
    },
)
CO3D_POSES = PoseConvention(
    "PyTorch3D's, as CO3D has them",
    {TRANSPOSED: rotations_transposed},
)


def find_pose_fault(cameras: Camera, convention: PoseConvention, all_around: bool = False) -> str:
    """What is wrong with the cameras of one capture, and the likely cause; empty where nothing is.

    Only the poses matter. A lone camera is never at fault, nor are cameras in several places that
    look the same way, unless their poses read as another convention show one point from many sides.
    Cameras that see all around have no direction to be wrong: they must only stand apart.
    """
    if len(cameras.world_to_cam) < 2:
        return ""
    mistake = "" if all_around else _likely_mistake(cameras, convention)
    belong = f"its poses must be {convention.name}"
    if mistake:
        belong += f", and look as if they were {mistake}"
    apart, away = _extent(cameras)
    if not _stand_apart(cameras):
        return (
            f"its cameras stand in one place, as far as single precision can tell ({apart:.1e} "
            f"apart, {away:.1e} from the origin); {belong}; coordinates of a map need a common "
            "offset taken off"
        )
    if all_around:
        return ""
    share = float((_angles_to_center_rad(cameras) < LOOKS_AT_RAD).mean())
    if mistake or (share < MIN_SHARE and not _look_the_same_way(cameras, PARALLEL_RAD)):
        return (
            f"its cameras look at nothing in common ({share:.0%} of them look at where their axes "
            f"meet); {belong}"
        )
    return ""


def _likely_mistake(cameras: Camera, convention: PoseConvention) -> str:
    """What the poses must be if they are to show one point from many sides; empty if they do."""
    angle_rad = _angles_to_center_rad(cameras).mean()
    fits: dict[str, float] = {}
    for name, reread in convention.mistakes.items():
        other = replace(cameras, world_to_cam=reread(cameras.world_to_cam))
        angles_rad = _angles_to_center_rad(other)
        if (
            (angles_rad < LOOKS_AT_RAD).mean() >= NEARLY_ALL
            and not _look_the_same_way(other, WIDE_RAD)
            and _stand_apart(other)
            and angle_rad > 2 * angles_rad.mean() + CLEARLY_RAD
        ):
            fits[name] = float(angles_rad.mean())
    as_well = min(fits.values(), default=0.0) + SAME_FIT_RAD
    return " or ".join(name for name in sorted(fits, key=fits.__getitem__) if fits[name] <= as_well)


def _extent(cameras: Camera) -> tuple[float, float]:
    """How far the cameras stand from their middle, and from the origin, at most."""
    centers = camera_centers(cameras)
    apart = np.linalg.norm(centers - centers.mean(0), axis=1).max()
    return float(apart), float(np.linalg.norm(centers, axis=1).max())


def _stand_apart(cameras: Camera) -> bool:
    apart, away = _extent(cameras)
    return apart > max(MIN_APART * away, ONE_PLACE)


def _angles_to_center_rad(cameras: Camera) -> Float[np.ndarray, " n"]:
    """Between each optical axis and the direction to the point where the axes meet."""
    towards = -directions_from(cameras, scene_center(cameras))
    forward = cameras.forward.double().numpy(force=True)
    return np.arccos(np.clip((forward * towards).sum(1), -1.0, 1.0))


def _look_the_same_way(cameras: Camera, within_rad: float) -> bool:
    axes = cameras.forward.double().numpy(force=True)
    mean = axes.mean(0)
    return bool((axes @ mean > np.cos(within_rad) * np.linalg.norm(mean)).all())
