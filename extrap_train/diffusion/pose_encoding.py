"""The relative pose as 19 numbers, in the two published conventions.

| | `zeronvs_pose` (`7dof_quantile_scale`) | `megascenes_pose` |
|---|---|---|
| camera axes | OpenGL | OpenCV |
| translation | squashed to 5·tanh(t / 10), about half of it | as it is |
| field of view | smaller of the query's two | along the query's diagonal |

Weights trained with one read the other as a turned and halved motion through another lens.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.geometry.foreign_cameras import opengl_from_world_to_cam
from extrap_train.views import Camera

POSE_CHANNELS = 19
_NEAREST_QUANTILE = 0.2


def depth_scale(depth: Float[Tensor, "b h w"], every: int, least: float) -> Float[Tensor, " b"]:
    """Scene scale of a reference: the 0.2 quantile of its known depth on every `every`-th pixel, at
    `least` so much; 1 if none is known.
    """
    sparse = depth[:, ::every, ::every].flatten(1)
    known = torch.where(sparse > 0, sparse, torch.nan)
    return known.nanquantile(_NEAREST_QUANTILE, 1).nan_to_num(1.0).clamp_min(least)


def zeronvs_pose(
    reference: Camera, query: Camera, scale: Float[Tensor, " b"]
) -> Float[Tensor, "b 19"]:
    """Relative pose and field of view: 16 matrix entries row by row, then fov, sin fov, cos fov.

    The matrix is inv(cam_to_world of the reference) @ cam_to_world of the query in OpenGL axes;
    its translation, in units of the scene scale, is squashed to 0.5·10·tanh(t/10). The field of
    view is the smaller of the query's two, in radians. Full precision also where the network runs
    in less: far from the world's origin the product would lose the translation.
    """
    with torch.autocast(reference.world_to_cam.device.type, enabled=False):
        reference_to_world = opengl_from_world_to_cam(reference.world_to_cam)
        query_to_world = opengl_from_world_to_cam(query.world_to_cam)
        relative = torch.linalg.inv(reference_to_world) @ query_to_world
        relative[:, :3, 3] = 5.0 * torch.tanh(relative[:, :3, 3] / scale[:, None] / 10.0)
        fov_rad = torch.minimum(
            2 * torch.atan(query.width / (2 * query.intrinsics[:, 0, 0])),
            2 * torch.atan(query.height / (2 * query.intrinsics[:, 1, 1])),
        )
        return _pose_vector(relative, fov_rad)


def megascenes_pose(
    reference: Camera, query: Camera, scale: Float[Tensor, " b"]
) -> Float[Tensor, "b 19"]:
    """Relative pose and field of view: 16 matrix entries row by row, then fov, sin fov, cos fov.

    The matrix is inv(cam_to_world of the reference) @ cam_to_world of the query in OpenCV axes; its
    translation is in units of the scene scale. The field of view is the query's along its diagonal
    at the horizontal focal length, in radians. Full precision, as `zeronvs_pose`.
    """
    with torch.autocast(reference.world_to_cam.device.type, enabled=False):
        relative = reference.world_to_cam @ query.cam_to_world
        relative[:, :3, 3] /= scale[:, None]
        diagonal = math.hypot(query.width, query.height)
        return _pose_vector(relative, 2 * torch.atan(diagonal / (2 * query.intrinsics[:, 0, 0])))


def _pose_vector(
    relative: Float[Tensor, "b 4 4"], fov_rad: Float[Tensor, " b"]
) -> Float[Tensor, "b 19"]:
    fov = torch.stack([fov_rad, fov_rad.sin(), fov_rad.cos()], -1)
    return torch.cat([relative.flatten(1), fov], -1)
