"""COLMAP's poses and camera models to ours and back.

COLMAP stores world-to-camera as a quaternion (w, x, y, z) and a translation; its axes (OpenCV's)
and pixel centres (+0.5) are ours already.
"""

from dataclasses import dataclass

import roma
import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.geometry.lens import Lens


@dataclass(frozen=True)
class CameraModel:
    """One of COLMAP's camera models: its number in binary files and its parameters in order."""

    number: int
    name: str
    parameters: tuple[str, ...]
    """`f` stands for `fx` and `fy`; the rest are names of OpenCV's coefficients."""
    fisheye: bool = False


CAMERA_MODELS = (
    CameraModel(0, "SIMPLE_PINHOLE", ("f", "cx", "cy")),
    CameraModel(1, "PINHOLE", ("fx", "fy", "cx", "cy")),
    CameraModel(2, "SIMPLE_RADIAL", ("f", "cx", "cy", "k1")),
    CameraModel(3, "RADIAL", ("f", "cx", "cy", "k1", "k2")),
    CameraModel(4, "OPENCV", ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")),
    CameraModel(5, "OPENCV_FISHEYE", ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"), True),
    CameraModel(
        6, "FULL_OPENCV", ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    ),
    CameraModel(8, "SIMPLE_RADIAL_FISHEYE", ("f", "cx", "cy", "k1"), True),
    CameraModel(9, "RADIAL_FISHEYE", ("f", "cx", "cy", "k1", "k2"), True),
    CameraModel(14, "SIMPLE_FISHEYE", ("f", "cx", "cy"), True),
    CameraModel(15, "FISHEYE", ("fx", "fy", "cx", "cy"), True),
)

NAMES_AND_COUNTS = {
    model.number: (model.name, len(model.parameters)) for model in CAMERA_MODELS
} | {
    7: ("FOV", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    12: ("SIMPLE_DIVISION", 4),
    13: ("DIVISION", 5),
    16: ("EUCM", 6),
    17: ("EQUIRECTANGULAR", 2),
}
"""Name and number of parameters of every model of COLMAP's; those not in `CAMERA_MODELS` cannot be
undone."""

_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_FISHEYE_COEFFICIENTS = ("k1", "k2", "k3", "k4")


def lens_from_parameters(
    values: dict[str, float], fisheye: bool = False, radial_r8: float = 0.0
) -> Lens:
    """A lens from named parameters; `f` alone stands for both focal lengths, others default to 0.

    Raises KeyError where a focal length or the principal point is missing.
    """
    focal = {"fx": values["f"], "fy": values["f"]} if "f" in values else values
    names = _FISHEYE_COEFFICIENTS if fisheye else _COEFFICIENTS
    return Lens(
        fx=focal["fx"],
        fy=focal["fy"],
        cx=values["cx"],
        cy=values["cy"],
        distortion=tuple(values.get(name, 0.0) for name in names),
        fisheye=fisheye,
        radial_r8=radial_r8,
    )


def world_to_cam_from_colmap(
    quaternion_wxyz: Float[Tensor, "*b 4"], translation: Float[Tensor, "*b 3"]
) -> Float[Tensor, "*b 4 4"]:
    """Our 4×4 matrix; the quaternion may have any length, but a zero one gives NaN."""
    unit = quaternion_wxyz / quaternion_wxyz.norm(dim=-1, keepdim=True)
    rotation = roma.unitquat_to_rotmat(roma.quat_wxyz_to_xyzw(unit))
    return roma.Rigid(rotation, translation).to_homogeneous()


def colmap_from_world_to_cam(
    world_to_cam: Float[Tensor, "*b 4 4"],
) -> tuple[Float[Tensor, "*b 4"], Float[Tensor, "*b 3"]]:
    """COLMAP's quaternion (w, x, y, z), w not negative, and translation."""
    xyzw = roma.rotmat_to_unitquat(world_to_cam[..., :3, :3])
    wxyz = roma.quat_xyzw_to_wxyz(xyzw)
    return torch.where(wxyz[..., :1] < 0, -wxyz, wxyz), world_to_cam[..., :3, 3]
