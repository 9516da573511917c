"""A network that knows the scene: exact point maps in a unit of its own."""

from collections.abc import Sequence

import torch
from torch import nn
from traced_scenes import Surface, render

from extrap_train.depth.mast3r.network.point_map_network import (
    Architecture,
    Encoding,
    PointMapNetwork,
    PredictedPoints,
)
from extrap_train.geometry.cameras import transform, unproject
from extrap_train.views import Camera, View


def exact_pair(
    scene: Sequence[Surface], first: Camera, second: Camera, unit: float
) -> tuple[PredictedPoints, PredictedPoints]:
    """What a perfect network says: both views' points in the first camera's frame."""
    maps = []
    for camera in (first, second):
        points = unproject(render(list(scene), camera).depth, camera)
        to_first = first.world_to_cam @ camera.cam_to_world
        moved = transform(to_first, points.flatten(0, 1)).view_as(points) / unit
        maps.append(PredictedPoints(moved[None], torch.full(moved.shape[:2], 5.0)[None]))
    return maps[0], maps[1]


class Oracle(PointMapNetwork):
    """Knows a prepared view, one of `seen`, by its picture."""

    def __init__(self, scene: Sequence[Surface], unit: float, seen: Sequence[View]) -> None:
        nn.Module.__init__(self)
        self.scene, self.unit, self.seen = scene, unit, seen
        self.architecture = Architecture()
        self.mask_token = nn.Parameter(torch.zeros(1, 1, 1))
        self.encoded = 0

    def encode(self, images: torch.Tensor) -> Encoding:
        self.encoded += 1
        return Encoding(images.flatten(2), (images.shape[-2] // 16, images.shape[-1] // 16))

    def decode(self, first: Encoding, second: Encoding) -> tuple[PredictedPoints, PredictedPoints]:
        cameras = [self._camera(encoding) for encoding in (first, second)]
        return exact_pair(self.scene, *cameras, self.unit)

    def _camera(self, encoding: Encoding) -> Camera:
        image = encoding.tokens[0] / 2 + 0.5
        return min(self.seen, key=lambda v: float((v.image.flatten(1) - image).abs().mean())).camera
