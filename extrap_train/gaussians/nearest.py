"""How near to an input anything can be, told from the inputs' cameras alone."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.views import Camera


def nearest_expected(cameras: Sequence[Camera]) -> Float[Tensor, " v"]:
    """Depth before which each camera of the frame has nothing in its picture; 0 if untold.

    Inputs around an object show it whole: it is inside the ball around the origin that a camera at
    distance d with a (lesser) field of view of 2α would see whole, d · sin α in radius, and begins
    at d · (1 − sin α). If one input does not have the origin in its picture, the inputs do not look
    at one thing, and all distances are 0.
    """
    sides = [_sides(camera) for camera in cameras]
    origins = [camera.world_to_cam[:3, 3] for camera in cameras]
    if not all((side @ origin > 0).all() for side, origin in zip(sides, origins, strict=True)):
        return cameras[0].world_to_cam.new_zeros(len(cameras))
    found = []
    for side, origin in zip(sides, origins, strict=True):
        half_rad = torch.asin(side[:, 2]).view(2, 2).mean(1).min()
        found.append(origin.norm() * (1 - torch.sin(half_rad)))
    return torch.stack(found)


def _sides(camera: Camera) -> Float[Tensor, "4 3"]:
    """Unit normals, inwards and in the camera's axes, of the planes through its picture's borders:
    left, right, top, bottom. A crop need not have the optical axis in its middle, or at all.
    """
    along = camera.intrinsics[:2]
    size = along.new_tensor([camera.width, camera.height])
    across = torch.stack([along, size[:, None] * camera.intrinsics[2] - along], 1)
    return torch.nn.functional.normalize(across.flatten(0, 1), dim=1)
