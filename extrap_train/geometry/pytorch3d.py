"""PyTorch3D's cameras, as CO3D stores them, to ours and back.

PyTorch3D multiplies row vectors from the left, `x_cam = x_world @ R + T`, and its camera looks
along +Z with +X to the *left* and +Y *up*. Focal length and principal point are in one of two NDC
units; both have their origin in the image's centre and grow to the left and upwards.
"""

from dataclasses import dataclass
from typing import Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor

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
