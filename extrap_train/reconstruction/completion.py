"""The incremental loop: choose, generate, align, check, merge (paper II-C)."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from extrap_train.config import CompletionConfig
from extrap_train.depth import DepthSource
from extrap_train.diffusion.generator import DiffusionGenerator, ViewGenerator
from extrap_train.geometry.cameras import unproject
from extrap_train.reconstruction.depth_prediction.inference import DepthPredictor
from extrap_train.reconstruction.global_map import (
    GENERATED,
    GIVEN,
    GlobalMap,
    MapView,
    Origin,
    prior_of,
)
from extrap_train.reconstruction.new_view import Proposal, propose, propose_predicted
from extrap_train.reconstruction.planner import REFERENCES, Query, next_query
from extrap_train.views import Camera, View, stack_cameras

MIN_OVERLAP = 50
"""Pixels that two branches must share to be compared."""


@dataclass(frozen=True)
class Step:
    """What adding one view took and gave."""

    name: str
    agreement: float
    attempts: int
    edges: int
    fresh_points: int
    loop_error: float | None
    """Distance between what two branches show of this view (`loop_error`), in scene units."""
    seconds: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class CompletionPipeline:
    """The models and options that new views are made with."""

    generator: ViewGenerator
    source: DepthSource
    """Measures the generated views' depth."""
    options: CompletionConfig
    seed: int
    predictor: DepthPredictor | None = None
    """Predicts the generated views' depth instead of `source`."""
    mirrored: tuple[MapView, ...] = ()
    """Photographs mirrored in the object's planes of symmetry. New views are made from them and
    aligned to them as to the photographs, but they are never part of the map.
    """

    def with_mirrored(self, mirrored: Sequence[MapView]) -> "CompletionPipeline":
        """With mirrored photographs, and with a diffusion model that takes twice as many views."""
        generator = self.generator
        if mirrored and isinstance(generator, DiffusionGenerator):
            most = generator.references or generator.model.config.num_condition_views
            generator = replace(generator, references=2 * most)
        return replace(self, generator=generator, mirrored=tuple(mirrored))

    def guided(self, scene_map: GlobalMap) -> GlobalMap:
        """The map with the mirrored photographs behind its own views."""
        return replace(scene_map, views=(*scene_map.views, *self.mirrored))


def map_of_inputs(
    views: Sequence[View], confidences: Sequence[torch.Tensor], tolerance: float
) -> GlobalMap:
    """The map of the given views; each must have a depth, and they are the roots of all others."""
    scene_map = GlobalMap(tolerance)
    for index, (view, confidence) in enumerate(zip(views, confidences, strict=True)):
        scene_map, _ = scene_map.added(view, confidence, Origin(GIVEN, root=index))
    return scene_map


def with_masks(scene_map: GlobalMap, masks: Sequence[Float[Tensor, "h w"] | None]) -> GlobalMap:
    """The map with the object's mask in each of its views; on disk, views have no masks."""
    pairs = zip(scene_map.views, masks, strict=True)
    views = (replace(view, view=replace(view.view, mask=mask)) for view, mask in pairs)
    return replace(scene_map, views=tuple(views))


def complete(
    scene_map: GlobalMap,
    queries: Sequence[Query],
    pipeline: CompletionPipeline,
    on_step: Callable[[GlobalMap, MapView, Step], None],
) -> GlobalMap:
    """Add every query that the map does not have yet; `on_step` is called after each."""
    done = {view.view.name for view in scene_map.views}
    left = [query for query in queries if query.name not in done]
    while left:
        started = time.perf_counter()
        query = next_query(scene_map, left)
        planned = time.perf_counter() - started
        left = [other for other in left if other.name != query.name]
        scene_map, added, step = add_view(scene_map, query, pipeline)
        step.seconds["plan"] = planned
        on_step(scene_map, added, step)
    return scene_map


def add_view(
    scene_map: GlobalMap, query: Query, pipeline: CompletionPipeline
) -> tuple[GlobalMap, MapView, Step]:
    """Generate one view and merge it into the map.

    While it contradicts the map it is generated again with another seed; the best attempt enters.
    """
    options, clock = pipeline.options, _Clock()
    known = pipeline.guided(scene_map)
    references = _references(scene_map, known, query, pipeline.options)
    neighbours = known.nearest(query.camera, options.edges)
    tries = options.confidence.attempts if options.confidence.regenerate else 1
    best: tuple[Proposal, int] | None = None
    attempts = 0
    for seed in range(pipeline.seed, pipeline.seed + tries):
        picture = _generate_picture(known, query, references, pipeline.generator, seed)
        clock.took("generate")
        if pipeline.predictor is None:
            proposal = propose(known, picture, neighbours, pipeline.source, options.confidence)
        else:
            proposal = propose_predicted(
                known, picture, neighbours, pipeline.predictor, options.confidence
            )
        clock.took("align")
        attempts += 1
        if best is None or proposal.agreement > best[0].agreement:
            best = (proposal, seed)
        if proposal.agreement >= options.confidence.least_agreement:
            break
    assert best is not None
    proposal, seed = best
    origin = Origin(
        GENERATED,
        root=known.views[references[0]].origin.root,
        references=tuple(index for index in references if index < len(scene_map)),
        seed=seed,
        agreement=proposal.agreement,
    )
    drift = loop_error(known, query.camera, neighbours)
    scene_map, added = scene_map.added(proposal.view, proposal.confidence, origin)
    clock.took("merge")
    step = Step(
        name=query.name,
        agreement=proposal.agreement,
        attempts=attempts,
        edges=proposal.edges,
        fresh_points=int(added.fresh.sum()),
        loop_error=drift,
        seconds=clock.seconds,
    )
    return scene_map, added, step


def _references(
    scene_map: GlobalMap, known: GlobalMap, query: Query, options: CompletionConfig
) -> list[int]:
    """Indices, in the guided map `known`, of what a view is generated from, nearest first.

    Mirrored photographs show the object alone and come in addition: what lies around it is seen
    from the others.
    """
    only_photographs = options.references == "photographs"
    own = scene_map.nearest(query.camera, REFERENCES, photographs=only_photographs)
    order = known.nearest(query.camera, len(known))
    mirrored = [index for index in order if index >= len(scene_map)][:REFERENCES]
    return [index for index in order if index in own or index in mirrored]


def loop_error(scene_map: GlobalMap, camera: Camera, neighbours: Sequence[int]) -> float | None:
    """The drift where a loop closes: how far apart two branches see the same pixels of a camera.

    A branch is all generated views whose chains of references begin at the same input. The median
    distance, in scene units; None where the nearest generated views are of one branch, or share
    too few pixels.
    """
    branches: dict[int, list[int]] = {}
    for index in neighbours:
        if scene_map.views[index].origin.kind == GENERATED:
            branches.setdefault(scene_map.views[index].origin.root, []).append(index)
    if len(branches) < 2:
        return None
    one, other = (prior_of(scene_map, camera, indices) for indices in list(branches.values())[:2])
    both = one.mask & other.mask
    if int(both.sum()) < MIN_OVERLAP:
        return None
    apart = (unproject(one.depth, camera) - unproject(other.depth, camera)).norm(dim=-1)
    return float(apart[both].median())


def _generate_picture(
    scene_map: GlobalMap,
    query: Query,
    references: Sequence[int],
    generator: ViewGenerator,
    seed: int,
) -> View:
    """The query's picture at the map's size, as an 8-bit file would keep it, so that a resumed run
    sees the same.
    """
    views = [scene_map.views[index].view for index in references]
    made = generator.generate(views, stack_cameras([query.camera]), [query.name], seed)
    size = (query.camera.height, query.camera.width)
    image = made.images
    if image.shape[-2:] != size:
        image = functional.interpolate(image, size, mode="bicubic")
    image = (image[0].clamp(0, 1) * 255).round() / 255
    return View(image, query.camera, name=query.name)


class _Clock:
    """Seconds by part; parts that come again add up."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def took(self, part: str) -> None:
        now = time.perf_counter()
        self.seconds[part] = self.seconds.get(part, 0.0) + now - self._last
        self._last = now
