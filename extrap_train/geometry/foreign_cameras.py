"""Other programs' cameras to ours and back.

PyTorch3D (CO3D)
    Multiplies row vectors from the left, `x_cam = x_world @ R + T`; its camera looks along +Z with
    +X to the *left* and +Y *up*. Focal length and principal point are in one of two NDC units; both
    have their origin in the image's centre and grow to the left and upwards.
OpenGL (nerfstudio, Blender, ZeroNVS, ARKit, RealityCapture)
    Stores `cam_to_world`, with +X right, +Y up, −Z forward.
COLMAP
    Stores world-to-camera as a quaternion (w, x, y, z) and a translation; its axes (OpenCV's) and
    pixel centres (+0.5) are ours already.
Metashape
    Stores camera-to-chunk, and a similarity from the chunk to the world; axes and pixel centres are
    COLMAP's.
"""

from dataclasses import dataclass
from typing import Literal, get_args

import roma
import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.geometry.lens import Lens
from extrap_train.views import Camera

NdcFormat = Literal["ndc_isotropic", "ndc_norm_image_bounds"]
NDC_FORMATS: tuple[str, ...] = get_args(NdcFormat)


@dataclass(frozen=True)
class Viewpoint:
    """CO3D's `viewpoint` entry, or a batch of them in the same NDC format."""

    rotation: Float[Tensor, "*b 3 3"]
    """`R`; its columns are the camera's left, up and forward axes in the world."""
    translation: Float[Tensor, "*b 3"]
    focal_length: Float[Tensor, "*b 2"]
    principal_point: Float[Tensor, "*b 2"]
    intrinsics_format: NdcFormat


def camera_from_viewpoint(viewpoint: Viewpoint, height: int, width: int) -> Camera:
    """The same camera in our convention, for an image of `height` × `width` pixels."""
    rotation, translation = viewpoint.rotation, viewpoint.translation
    flip = _left_up_to_right_down(rotation)
    world_to_cam = torch.zeros(*rotation.shape[:-2], 4, 4, dtype=rotation.dtype)
    world_to_cam[..., :3, :3] = flip[:, None] * rotation.mT
    world_to_cam[..., :3, 3] = flip * translation
    world_to_cam[..., 3, 3] = 1

    half_size, unit = _half_size_and_unit(viewpoint.intrinsics_format, height, width, rotation)
    focal = viewpoint.focal_length * unit
    principal = half_size - viewpoint.principal_point * unit
    intrinsics = torch.zeros(*rotation.shape[:-2], 3, 3, dtype=rotation.dtype)
    intrinsics[..., 0, 0], intrinsics[..., 1, 1] = focal[..., 0], focal[..., 1]
    intrinsics[..., 0, 2], intrinsics[..., 1, 2] = principal[..., 0], principal[..., 1]
    intrinsics[..., 2, 2] = 1
    return Camera(world_to_cam, intrinsics, height, width)


def viewpoint_from_camera(
    camera: Camera, intrinsics_format: NdcFormat = "ndc_isotropic"
) -> Viewpoint:
    """The inverse of `camera_from_viewpoint`."""
    flip = _left_up_to_right_down(camera.world_to_cam)
    half_size, unit = _half_size_and_unit(
        intrinsics_format, camera.height, camera.width, camera.intrinsics
    )
    focal = camera.intrinsics.diagonal(dim1=-2, dim2=-1)[..., :2]
    return Viewpoint(
        rotation=(flip[:, None] * camera.world_to_cam[..., :3, :3]).mT,
        translation=flip * camera.world_to_cam[..., :3, 3],
        focal_length=focal / unit,
        principal_point=(half_size - camera.intrinsics[..., :2, 2]) / unit,
        intrinsics_format=intrinsics_format,
    )


def _left_up_to_right_down(like: Tensor) -> Float[Tensor, "3"]:
    """PyTorch3D's camera axes in terms of ours; the map is its own inverse."""
    return like.new_tensor([-1.0, -1.0, 1.0])


def _half_size_and_unit(
    intrinsics_format: NdcFormat, height: int, width: int, like: Tensor
) -> tuple[Float[Tensor, "2"], Float[Tensor, "2"]]:
    """Half the image's (width, height), and the pixels that one NDC unit spans in u and v."""
    half_size = like.new_tensor([width / 2, height / 2])
    if intrinsics_format == "ndc_norm_image_bounds":
        return half_size, half_size
    return half_size, half_size.min().expand(2)


def world_to_cam_from_opengl(cam_to_world: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 4 4"]:
    """Our `world_to_cam` from an OpenGL camera's `cam_to_world`, which must be rigid."""
    return rigid_inverse(flip_up_and_forward(cam_to_world))


def opengl_from_quaternion(
    quaternion_xyzw: Float[Tensor, "*b 4"], translation: Float[Tensor, "*b 3"]
) -> Float[Tensor, "*b 4 4"]:
    """An OpenGL camera's `cam_to_world`; the quaternion may have any length but 0, which is NaN."""
    return _rigid_transform(quaternion_xyzw, translation)


def opengl_from_heading(
    angles_rad: Float[Tensor, "*b 3"], position: Float[Tensor, "*b 3"]
) -> Float[Tensor, "*b 4 4"]:
    """An OpenGL camera's `cam_to_world` from RealityCapture's heading, pitch and roll.

    The camera looks down (−Z) where all are 0: roll turns it about its +Y, then pitch about +X, and
    heading clockwise about +Z.
    """
    signed = angles_rad * angles_rad.new_tensor([-1.0, 1.0, 1.0])
    rotation = roma.euler_to_rotmat("ZXY", signed)
    return roma.Rigid(rotation, position).to_homogeneous()


def opengl_from_world_to_cam(world_to_cam: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 4 4"]:
    """An OpenGL camera's `cam_to_world` from our `world_to_cam`."""
    return flip_up_and_forward(rigid_inverse(world_to_cam))


def flip_up_and_forward(cam_to_world: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 4 4"]:
    """Swap between the two conventions; the world stays as it is."""
    return cam_to_world * cam_to_world.new_tensor([1.0, -1.0, -1.0, 1.0])


def rigid_inverse(rigid: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 4 4"]:
    """The inverse of a rotation and a translation."""
    return roma.Rigid.from_homogeneous(rigid).inverse().to_homogeneous()


@dataclass(frozen=True)
class CameraModel:
    """One of COLMAP's camera models: its number in binary files and its parameters in order."""

    number: int
    name: str
    parameters: tuple[str, ...]
    """`f` stands for `fx` and `fy`; the rest are names of OpenCV's coefficients."""
    fisheye: bool = False


PANORAMA = "EQUIRECTANGULAR"

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
    CameraModel(17, PANORAMA, ("w", "h")),
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
    return _rigid_transform(roma.quat_wxyz_to_xyzw(quaternion_wxyz), translation)


def colmap_from_world_to_cam(
    world_to_cam: Float[Tensor, "*b 4 4"],
) -> tuple[Float[Tensor, "*b 4"], Float[Tensor, "*b 3"]]:
    """COLMAP's quaternion (w, x, y, z), w not negative, and translation."""
    xyzw = roma.rotmat_to_unitquat(world_to_cam[..., :3, :3])
    wxyz = roma.quat_xyzw_to_wxyz(xyzw)
    return torch.where(wxyz[..., :1] < 0, -wxyz, wxyz), world_to_cam[..., :3, 3]


def _rigid_transform(
    quaternion_xyzw: Float[Tensor, "*b 4"], translation: Float[Tensor, "*b 3"]
) -> Float[Tensor, "*b 4 4"]:
    unit = quaternion_xyzw / quaternion_xyzw.norm(dim=-1, keepdim=True)
    return roma.Rigid(roma.unitquat_to_rotmat(unit), translation).to_homogeneous()
