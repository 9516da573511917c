"""Training examples of the depth network: the views that completion generates, from captures of
known depth.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from extrap_train.config import CompletionConfig, ConfidenceConfig
from extrap_train.data.sequences import Frame
from extrap_train.depth import DatasetDepth, DepthSource
from extrap_train.diffusion.generator import ViewGenerator
from extrap_train.geometry.cameras import WorldFrame
from extrap_train.reconstruction.completion import CompletionPipeline, complete, map_of_inputs
from extrap_train.reconstruction.depth_prediction.inference import PredictedDepth, observe_in_map
from extrap_train.reconstruction.depth_prediction.observation import Observation
from extrap_train.reconstruction.global_map import GENERATED, GlobalMap
from extrap_train.reconstruction.inputs import choose_frames, first_views, fit_world_frame
from extrap_train.reconstruction.planner import orbit_queries
from extrap_train.views import Camera, View, combine, stack_poses

Truth = Callable[[Camera], tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]]
"""A capture's depth and object mask from any camera, in its own world and unit."""

MIN_FRAMES = 12
"""Frames that a capture needs, so that neighbouring photographs stand at most 30° apart."""
MAX_INPUTS = 6
"""Most photographs that a capture is completed from; the fewest are three."""
STEP_DEG = (22.0, 40.0)
"""Range of the angle between neighbouring views of the orbit."""
MAX_ERROR = 0.04
"""Relative error of the depths that views enter the map with: one standard deviation, at most."""
_KNOTS = 5
"""Knots of the smooth error field of a depth map, along each side."""


@dataclass(frozen=True)
class DepthExamples:
    """Observations with the truth."""

    seen: Observation
    log_depth: Float[Tensor, "b h w"]
    weight: Float[Tensor, "b h w"]
    """0 where the truth is unknown; highest on the object where no reference is certain."""


def draw_examples(
    frames: Sequence[Frame],
    truth: Truth,
    generator: ViewGenerator,
    source: DepthSource,
    rng: np.random.Generator,
) -> DepthExamples:
    """Complete a capture from neighbouring photographs and record every view's observation.

    The frames have depth, which the photographs keep in half of the captures; in the others it is
    measured. Generated views enter the map with the true depth, spoiled smoothly. Each is observed
    twice: when it is generated, and from its nearest neighbours once all views are there.
    """
    count = int(rng.integers(3, MAX_INPUTS + 1))
    chosen = [
        frames[i] for i in choose_frames(frames, count, (), "one_sided", int(rng.integers(99)))
    ]
    world = fit_world_frame(stack_poses([frame.camera for frame in chosen]))
    measuring = source if rng.random() < 0.5 else DatasetDepth()
    photographs = [frame.load() for frame in chosen]
    views, confidences = first_views(photographs, measuring, world, generator.warp_size)
    options = CompletionConfig(confidence=ConfidenceConfig(regenerate=False))
    recorder = _Recorder(truth, world, source, rng.uniform(0, MAX_ERROR), rng)
    pipeline = CompletionPipeline(generator, source, options, int(rng.integers(2**31)), recorder)
    scene_map = map_of_inputs(views, confidences, options.tolerance)
    queries = orbit_queries(scene_map.cameras, np.radians(rng.uniform(*STEP_DEG)))
    scene_map = complete(scene_map, queries, pipeline, lambda *_: None)
    for index, view in enumerate(scene_map.views):
        if view.origin.kind == GENERATED:
            nearest = scene_map.nearest(view.camera, options.edges + 1)
            others = [other for other in nearest if other != index]
            recorder(scene_map, view.view, others[: options.edges])
    return combine(recorder.examples, torch.cat)


@dataclass(frozen=True)
class _Recorder:
    """A `DepthPredictor` that knows the truth and spoils it."""

    truth: Truth
    world: WorldFrame
    source: DepthSource
    error: float
    rng: np.random.Generator
    examples: list[DepthExamples] = field(default_factory=list)

    def __call__(
        self, scene_map: GlobalMap, picture: View, indices: Sequence[int]
    ) -> PredictedDepth:
        seen = observe_in_map(scene_map, picture, indices, self.source)
        camera = picture.camera.resized(*seen.certain.shape[-2:])
        depth, mask = self.truth(self.world.outside(camera))
        depth = depth / self.world.unit
        self.examples.append(with_truth(seen, depth, mask))
        error = self.error * _smooth_field(depth.shape, self.rng)
        confidence = (1 - error.abs() / MAX_ERROR).clamp(0.1, 0.9)
        certain = seen.certain[0]
        spoiled = depth * (1 + torch.where(certain, 0, error))
        completed = PredictedDepth(spoiled, confidence, certain)
        return completed.resized(picture.camera.height, picture.camera.width)


def with_truth(
    seen: Observation, depth: Float[Tensor, "h w"], mask: Float[Tensor, "h w"]
) -> DepthExamples:
    """One observation with the depth that it should lead to, and the object's mask."""
    log_depth = (depth / seen.center_depth).clamp(min=1e-3).log()[None]
    uncertain = ~seen.certain[0]
    weight = 0.25 + 0.75 * uncertain + 4.0 * (uncertain & (mask > 0.5))
    return DepthExamples(seen, log_depth, torch.where(depth > 0, weight, 0)[None])


def _smooth_field(shape: torch.Size, rng: np.random.Generator) -> Float[Tensor, "h w"]:
    knots = torch.from_numpy(rng.normal(size=(1, 1, _KNOTS, _KNOTS))).float()
    return functional.interpolate(knots, shape, mode="bicubic", align_corners=True)[0, 0]
