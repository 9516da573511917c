"""The relative pose as 19 numbers, in ZeroNVS's convention (`7dof_quantile_scale`)."""

import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.geometry.opengl import opengl_from_world_to_cam
from extrap_train.views import Camera

POSE_CHANNELS = 19
_NEAREST_QUANTILE = 0.2
_LEAST_SCALE = 1e-2


def depth_scale(depth: Float[Tensor, "b h w"]) -> Float[Tensor, " b"]:
    """Scene scale of a reference: the 0.2 quantile of its known depth on every fourth pixel; 1 if
    none.
    """
    scales = []
    for sparse in depth[:, ::4, ::4]:
        known = sparse[sparse > 0]
        scales.append(known.quantile(_NEAREST_QUANTILE) if known.numel() else sparse.new_ones(()))
    return torch.stack(scales).clamp_min(_LEAST_SCALE)


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
        return _zeronvs_pose(reference, query, scale)


def _zeronvs_pose(
    reference: Camera, query: Camera, scale: Float[Tensor, " b"]
) -> Float[Tensor, "b 19"]:
    reference_to_world = opengl_from_world_to_cam(reference.world_to_cam)
    query_to_world = opengl_from_world_to_cam(query.world_to_cam)
    relative = torch.linalg.inv(reference_to_world) @ query_to_world
    relative[:, :3, 3] = 5.0 * torch.tanh(relative[:, :3, 3] / scale[:, None] / 10.0)
    fov_rad = torch.minimum(
        2 * torch.atan(query.width / (2 * query.intrinsics[:, 0, 0])),
        2 * torch.atan(query.height / (2 * query.intrinsics[:, 1, 1])),
    )
    fov = torch.stack([fov_rad, fov_rad.sin(), fov_rad.cos()], -1)
    return torch.cat([relative.flatten(1), fov], -1)
