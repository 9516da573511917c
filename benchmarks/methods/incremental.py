"""A diffusion method that generates the targets in turn, from the inputs and earlier targets."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.methods.base import SceneInputs, Synthesis
from benchmarks.methods.diffusion import Diffusion, target_names
from extrap_train.config import CompletionConfig, StereoConfig
from extrap_train.depth.sources import depth_source
from extrap_train.diffusion.generator import GeneratedViews, ViewGenerator
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.geometry.cameras import WorldFrame
from extrap_train.reconstruction.cloud import cloud_of
from extrap_train.reconstruction.completion import CompletionPipeline, Step, complete, map_of_inputs
from extrap_train.reconstruction.fusion import fuse_depths
from extrap_train.reconstruction.global_map import GENERATED, GlobalMap
from extrap_train.reconstruction.inputs import first_views, fit_world_frame
from extrap_train.reconstruction.planner import Query
from extrap_train.views import Camera, View, stack_cameras


@dataclass(frozen=True)
class IncrementalDiffusion(Diffusion):
    """The incremental loop with the targets as its queries (paper II-C).

    Every generated view is given depth, checked against the map, merged, and a reference from then
    on; the loop chooses the order. Only the inputs' depth is given: that of the generated views is
    stereo's, whatever source the inputs' came from.
    """

    def sample(self, model: ExtrapolationModel, inputs: SceneInputs) -> Synthesis:
        """Sample and merge every target; returns the points of the whole map as well."""
        options = CompletionConfig(references="all")
        world = fit_world_frame(stack_cameras([view.camera for view in inputs.fine_views]))
        size = model.config.warp_size
        views, confidences = first_views(inputs.fine_views, inputs.depth_source, world, size)
        scene_map = map_of_inputs(views, confidences, options.tolerance)
        generator = _Remembering(self.generator(model))
        pipeline = CompletionPipeline(generator, depth_source(StereoConfig()), options, inputs.seed)
        cameras = world.inside(inputs.targets.squared(size))
        names = target_names(inputs)
        queries = [Query(name, cameras[index]) for index, name in enumerate(names)]
        steps: list[Step] = []
        scene_map = complete(scene_map, queries, pipeline, lambda _, __, step: steps.append(step))
        # For every view, the attempt that the map kept, as it was generated.
        seeds = {v.view.name: v.origin.seed for v in scene_map.views if v.origin.kind == GENERATED}
        agreeing = [s for s in steps if s.agreement >= options.confidence.least_agreement]
        return Synthesis(
            images=torch.stack([generator.pictures[name, seeds[name]] for name in names]),
            given={"references": "inputs and generated views", "generated views' depth": "stereo"},
            points=_points(scene_map, world, options),
            counts={
                "pictures": float(sum(step.attempts for step in steps)),
                "agreeing_views": float(len(agreeing)),
            },
        )


@dataclass(frozen=True)
class _Remembering:
    """Generates as another generator does and keeps its pictures: the map holds resampled ones."""

    inner: ViewGenerator
    pictures: dict[tuple[str, int], Float[Tensor, "3 h w"]] = field(default_factory=dict)
    """By name and seed."""

    @property
    def image_size(self) -> int:
        """See `ViewGenerator.image_size`."""
        return self.inner.image_size

    @property
    def warp_size(self) -> int:
        """See `ViewGenerator.warp_size`."""
        return self.inner.warp_size

    def generate(
        self, references: Sequence[View], queries: Camera, names: Sequence[str], seed: int = 0
    ) -> GeneratedViews:
        """See `ViewGenerator.generate`."""
        made = self.inner.generate(references, queries, names, seed)
        self.pictures.update(
            {(name, seed): image for name, image in zip(names, made.images, strict=True)}
        )
        return made


def _points(
    scene_map: GlobalMap, world: WorldFrame, options: CompletionConfig
) -> Float[Tensor, "m 3"]:
    """The map's points that are sure enough, in the photographs' world."""
    cloud = cloud_of(fuse_depths(scene_map), votes=options.confidence.votes)
    return world.points_outside(
        cloud[cloud.confidence >= options.confidence.least_confidence].points
    )
