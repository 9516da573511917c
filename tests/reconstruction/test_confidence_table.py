"""What each part of the confidence handling is worth: a synthetic scene, exact pictures and depth,
and one generated view in five spoiled, for good or at the first attempt. Run with `-s` for a table.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from jaxtyping import Float
from torch import Tensor
from torchvision.transforms.functional import gaussian_blur

from extrap_train.config import CompletionConfig, ConfidenceConfig
from extrap_train.data.scene_spec import open_scene
from extrap_train.data.synthetic import build_scene
from extrap_train.depth import DepthMap, PointMaps, point_maps_of
from extrap_train.diffusion.generator import GeneratedViews
from extrap_train.reconstruction.cloud import cloud_of
from extrap_train.reconstruction.completion import CompletionPipeline, complete, map_of_inputs
from extrap_train.reconstruction.exact import ExactDepth, ExactGenerator
from extrap_train.reconstruction.inputs import choose_frames, first_views, fit_world_frame
from extrap_train.reconstruction.map_scores import cloud_scores
from extrap_train.reconstruction.planner import orbit_queries
from extrap_train.views import Camera, View, stack_poses

_SIZE = 128
_PARTS = ("repair", "free_space", "support", "votes", "regenerate", "reject")

Spoil = Callable[[Float[Tensor, "c h w"]], Float[Tensor, "c h w"]]


def _shifted(image: Float[Tensor, "c h w"]) -> Float[Tensor, "c h w"]:
    return image.roll(5, -1)


def _blurred(image: Float[Tensor, "c h w"]) -> Float[Tensor, "c h w"]:
    return gaussian_blur(image, [13, 13], [3.0, 3.0])


@dataclass(frozen=True)
class _SpoiledGenerator:
    """Exact pictures but for some; with `stubborn`, no other seed mends these."""

    exact: ExactGenerator
    names: Sequence[str]
    spoil: Spoil
    stubborn: bool

    @property
    def image_size(self) -> int:
        return self.exact.image_size

    warp_size = image_size

    def generate(
        self, references: Sequence[View], queries: Camera, names: Sequence[str], seed: int = 0
    ) -> GeneratedViews:
        made = self.exact.generate(references, queries, names, seed)
        spoiled = [name in self.names and (self.stubborn or seed == 0) for name in names]
        images = [
            self.spoil(image) if bad else image
            for image, bad in zip(made.images, spoiled, strict=True)
        ]
        return replace(made, images=torch.stack(images))


@dataclass(frozen=True)
class _DepthOfThePicture:
    """Depth as a pairwise model has it: of what the picture shows, spoiled where that is."""

    exact: ExactDepth
    truth: ExactGenerator
    names: Sequence[str]
    spoil: Spoil

    @property
    def image_size(self) -> None:
        return None

    def depth_map(self, view: View, neighbours: Sequence[View]) -> DepthMap:
        found = self.exact.depth_map(view, neighbours)
        if view.name not in self.names or view.depth is not None:
            return found
        right = self.truth.photograph(view.camera)
        if (view.image - right).abs().mean() < 1e-2:
            return found
        depth = self.spoil(found.depth[None])[0]
        return DepthMap(depth, (depth > 0).to(depth.dtype))

    def depth_maps(self, views: Sequence[View]) -> list[DepthMap]:
        return [self.depth_map(view, ()) for view in views]

    def point_maps(self, first: View, second: View) -> PointMaps:
        one, two = self.depth_map(first, ()), self.depth_map(second, ())
        return point_maps_of(first, one, replace(second, depth=two.depth), two)


def _accuracy(spoil: Spoil, stubborn: bool, handling: ConfidenceConfig) -> dict[str, float]:
    sequence, scene = open_scene("synthetic:hydrant/0001"), build_scene("hydrant", 1, 0)
    frames = [sequence.frames[i] for i in choose_frames(sequence.frames, 3, [], "one_sided", 0)]
    world = fit_world_frame(stack_poses([frame.camera for frame in frames]))
    exact = ExactGenerator(scene, _SIZE, world)
    measured = ExactDepth(scene, world)
    views, confidences = first_views([f.load() for f in frames], measured, world, _SIZE)
    options = CompletionConfig(confidence=handling)
    known = map_of_inputs(views, confidences, options.tolerance)
    queries = orbit_queries(known.cameras, np.radians(30))
    names = [query.name for query in queries[2::5]]
    pipeline = CompletionPipeline(
        _SpoiledGenerator(exact, names, spoil, stubborn),
        _DepthOfThePicture(measured, exact, names, spoil),
        options,
        0,
    )
    grown = complete(known, queries, pipeline, lambda *_: None)
    cloud = cloud_of(grown, votes=handling.votes)
    cloud = cloud[cloud.confidence >= handling.least_confidence]
    return cloud_scores({"": cloud}, scene, world)[""]


@pytest.mark.slow
@pytest.mark.parametrize("stubborn", [False, True], ids=["first attempt", "every attempt"])
@pytest.mark.parametrize("spoil", [_shifted, _blurred])
def test_handling_keeps_spoiled_views_out(spoil: Spoil, stubborn: bool) -> None:
    off = dict.fromkeys(_PARTS, False)
    settings = {"everything on": ConfidenceConfig(), "everything off": ConfidenceConfig(**off)}
    settings |= {f"without {part}": ConfidenceConfig(**{part: False}) for part in _PARTS}
    accuracy = {}
    for name, handling in settings.items():
        scores = _accuracy(spoil, stubborn, handling)
        accuracy[name] = scores["accuracy"]
        print(
            f"{spoil.__name__}, {'every' if stubborn else 'first'} attempt, {name}: accuracy "
            f"{scores['accuracy']:.3f}, completeness {scores['completeness']:.3f}"
        )
    assert accuracy["everything on"] >= accuracy["everything off"] + 0.1
