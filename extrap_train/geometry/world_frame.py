"""A normalised world, centred on the scene: thresholds mean the same whatever unit and origin the
photographs' poses have.
"""

from dataclasses import dataclass, replace

from jaxtyping import Float
from torch import Tensor

from extrap_train.views import Camera, View


@dataclass(frozen=True)
class WorldFrame:
    """`x_outside = unit · x_inside + center`; computed in double precision."""

    center: Float[Tensor, "3"]
    """In the photographs' world."""
    unit: float
    """Length of 1 of the frame, in the photographs' world."""

    def inside(self, camera: Camera) -> Camera:
        """A camera (or batch) of the photographs' world in the frame."""
        matrix, center = camera.world_to_cam.double(), self.center.to(camera.world_to_cam.device)
        shift = matrix[..., :3, :3] @ center.double() + matrix[..., :3, 3]
        return _with_translation(camera, shift / self.unit)

    def outside(self, camera: Camera) -> Camera:
        """A camera (or batch) of the frame in the photographs' world."""
        matrix, center = camera.world_to_cam.double(), self.center.to(camera.world_to_cam.device)
        shift = matrix[..., :3, 3] * self.unit - matrix[..., :3, :3] @ center.double()
        return _with_translation(camera, shift)

    def view_inside(self, view: View) -> View:
        """A posed photograph in the frame, its depth with it."""
        depth = None if view.depth is None else view.depth / self.unit
        return replace(view, camera=self.inside(view.camera), depth=depth)

    def points_outside(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Points of the frame in the photographs' world."""
        center = self.center.to(points.device).double()
        return (points.double() * self.unit + center).to(points.dtype)


def _with_translation(camera: Camera, translation: Float[Tensor, "*b 3"]) -> Camera:
    matrix = camera.world_to_cam.clone()
    matrix[..., :3, 3] = translation.to(matrix.dtype)
    return replace(camera, world_to_cam=matrix)
