"""A plane as a mirror: points, cameras and photographs as it shows them."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.views import Camera, View


@dataclass(frozen=True)
class MirrorPlane:
    """The plane of all points x with `normal · x = offset`, or a batch of planes."""

    normal: Float[Tensor, "*b 3"]
    """Unit length."""
    offset: Float[Tensor, "*b"]
    """In scene units."""

    def reflect(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "*b n 3"]:
        """The points' images: `x − 2 (normal · x − offset) normal`."""
        beyond = points @ self.normal[..., None] - self.offset[..., None, None]
        return points - 2 * beyond * self.normal[..., None, :]


def mirrored_view(view: View, plane: MirrorPlane) -> View:
    """The photograph that a camera behind the mirror would take of the mirrored scene.

    A reflection turns right-handed axes into left-handed ones; flipping the picture from left to
    right turns them back, so that the result is an ordinary posed view: what it shows of an object
    with this plane of symmetry is true of the object itself.
    """
    return replace(
        view,
        image=view.image.flip(-1),
        camera=_mirrored_camera(view.camera, plane),
        depth=None if view.depth is None else view.depth.flip(-1),
        mask=None if view.mask is None else view.mask.flip(-1),
    )


def _mirrored_camera(camera: Camera, plane: MirrorPlane) -> Camera:
    normal = plane.normal.to(camera.world_to_cam)
    reflection = torch.eye(4).to(normal)
    reflection[:3, :3] -= 2 * torch.outer(normal, normal)
    reflection[:3, 3] = 2 * plane.offset.to(normal) * normal
    flip = torch.diag(torch.tensor([-1.0, 1.0, 1.0, 1.0])).to(normal)
    intrinsics = camera.intrinsics.clone()
    intrinsics[0, 2] = camera.width - intrinsics[0, 2]
    return replace(
        camera, world_to_cam=flip @ camera.world_to_cam @ reflection, intrinsics=intrinsics
    )
