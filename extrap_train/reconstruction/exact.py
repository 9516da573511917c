"""Views and depth without error, from a synthetic scene's renderer: what remains is geometry."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.data.examples import query_batch
from extrap_train.data.synthetic import SyntheticScene, render, trace
from extrap_train.depth import DepthMap, PointMaps, point_maps_of
from extrap_train.diffusion.generator import GeneratedViews
from extrap_train.geometry.cameras import WorldFrame
from extrap_train.geometry.warp import compute_warp
from extrap_train.reconstruction.planner import REFERENCES
from extrap_train.views import Camera, View


@dataclass(frozen=True)
class ExactGenerator:
    """A `ViewGenerator` that photographs the scene."""

    scene: SyntheticScene
    image_size: int
    world: WorldFrame
    """Frame of the map that views and queries belong to."""

    @property
    def warp_size(self) -> int:
        """Side of the warps, the same as that of the pictures."""
        return self.image_size

    def generate(
        self, references: Sequence[View], queries: Camera, names: Sequence[str], seed: int = 0
    ) -> GeneratedViews:
        """The true pictures; the seed changes nothing."""
        batch, chosen = query_batch(references, queries, REFERENCES, self.image_size)
        batch = compute_warp(batch)
        images = [self.photograph(batch.camera[i]) for i in range(len(queries.world_to_cam))]
        assert batch.warp is not None
        return GeneratedViews(torch.stack(images), batch.camera, batch.warp, chosen)

    def photograph(self, camera: Camera) -> Float[Tensor, "3 h w"]:
        """The picture that a camera in the map's world would take."""
        return render(self.scene, self.world.outside(camera)).image


@dataclass(frozen=True)
class ExactDepth:
    """A `DepthSource` that measures the scene; what a view's picture shows does not matter."""

    scene: SyntheticScene
    world: WorldFrame
    """Frame of the map that the views belong to."""

    @property
    def image_size(self) -> None:
        """None: depth comes at the size of the photographs."""

    def depth_map(self, view: View, neighbours: Sequence[View]) -> DepthMap:
        """The true depth; the neighbours are not looked at."""
        depth = view.depth
        if depth is None:
            depth = trace(self.scene, self.world.outside(view.camera))[0] / self.world.unit
        return DepthMap(depth, (depth > 0).to(depth.dtype))

    def depth_maps(self, views: Sequence[View]) -> list[DepthMap]:
        """Every view's true depth."""
        return [self.depth_map(view, ()) for view in views]

    def point_maps(self, first: View, second: View) -> PointMaps:
        """Both views' points in the first camera's frame."""
        one, two = self.depth_map(first, ()), self.depth_map(second, ())
        return point_maps_of(first, one, replace(second, depth=two.depth), two)
