"""The points that Gaussians start from, found from the input views alone."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from extrap_train.depth import DepthMap
from extrap_train.gaussians.nearest import nearest_expected
from extrap_train.geometry.cameras import unproject_to_world
from extrap_train.views import Camera, View

FARTHEST = 10.0
"""Greatest depth of random points, as a multiple of the scene centre's depth."""
NEAREST_UNKNOWN = 0.5
"""Least one, in the same, where the inputs do not tell (`nearest_expected`)."""


@dataclass(frozen=True)
class Points:
    """Coloured points in the frame that Gaussians are fitted in."""

    positions: Float[Tensor, "n 3"]
    colors: Float[Tensor, "n 3"]
    """In [0, 1]."""
    confidence: Float[Tensor, " n"]
    """As depth sources give it; 1 for points that do not come from depth."""

    def __len__(self) -> int:
        return len(self.positions)

    def __getitem__(self, index: Int[Tensor, " m"] | Bool[Tensor, " n"]) -> "Points":
        return Points(self.positions[index], self.colors[index], self.confidence[index])

    def at_most(self, count: int, generator: torch.Generator) -> "Points":
        """All of them, or an even draw of `count`."""
        if len(self) <= count:
            return self
        return self[torch.randperm(len(self), generator=generator)[:count].sort().values]


def joined(parts: Sequence[Points]) -> Points:
    """All the points of several sets."""
    return Points(
        torch.cat([part.positions for part in parts]),
        torch.cat([part.colors for part in parts]),
        torch.cat([part.confidence for part in parts]),
    )


def random_points(cameras: Sequence[Camera], count: int, generator: torch.Generator) -> Points:
    """Points that at least one input camera sees, in random colors.

    Even over the cameras, their pixels, and the logarithm of depth, from the nearest that can be
    expected to 10 times that of the scene's centre, which the frame puts at the origin:
    surroundings have no far end.
    """
    expected = nearest_expected(cameras)
    which = torch.randint(len(cameras), (count,), generator=generator)
    place = torch.rand(count, 3, generator=generator)
    positions = torch.empty(count, 3)
    for index, camera in enumerate(cameras):
        mine = which == index
        reach = max(float(camera.world_to_cam[2, 3]), 0.1)
        nearest = float(expected[index]) or NEAREST_UNKNOWN * reach
        depth = nearest * (FARTHEST * reach / nearest) ** place[mine, 2]
        pixels = place[mine, :2] * torch.tensor([camera.width, camera.height])
        homogeneous = torch.cat([pixels, torch.ones(len(pixels), 1)], 1)
        rays = homogeneous @ torch.linalg.inv(camera.intrinsics).T
        cam_to_world = camera.cam_to_world
        positions[mine] = (rays * depth[:, None]) @ cam_to_world[:3, :3].T + cam_to_world[:3, 3]
    return Points(positions, torch.rand(count, 3, generator=generator), torch.ones(count))


def pixel_points(
    view: View, depth_map: DepthMap, wanted: Bool[Tensor, "h w"] | None = None
) -> Points:
    """One point a pixel whose depth is reliable (and wanted)."""
    known = depth_map.reliable() > 0
    if wanted is not None:
        known = known & wanted
    positions = unproject_to_world(depth_map.depth, view.camera)
    return Points(positions[known], view.image.permute(1, 2, 0)[known], depth_map.confidence[known])
