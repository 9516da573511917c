"""`task=complete`: from a few posed photographs of a scene to a full turn around it."""

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from extrap_train.config import DatasetDepthConfig, SyntheticConfig, TrainConfig, dotted
from extrap_train.data.scene_spec import SYNTHETIC_SCHEME
from extrap_train.data.sequences import NO_CATEGORY, Frame, FrameSequence
from extrap_train.data.square_frames import load_readable, require_few_unusable
from extrap_train.data.synthetic import SyntheticScene, build_scene
from extrap_train.depth.sources import depth_source, source_of_generated
from extrap_train.device import advise_on_sampling_memory
from extrap_train.errors import InputError
from extrap_train.gaussians.spz import require_gsply
from extrap_train.geometry.cameras import WorldFrame
from extrap_train.reconstruction.capture_check import check_poses
from extrap_train.reconstruction.cloud_pictures import draw_plan
from extrap_train.reconstruction.completion import (
    CompletionPipeline,
    Step,
    complete,
    map_of_inputs,
)
from extrap_train.reconstruction.depth_prediction.inference import NetworkDepth
from extrap_train.reconstruction.depth_prediction.network import load_depth_network
from extrap_train.reconstruction.exact import ExactDepth, ExactGenerator
from extrap_train.reconstruction.fusion import fuse_depths
from extrap_train.reconstruction.global_map import GlobalMap, MapView
from extrap_train.reconstruction.inputs import (
    check_cameras,
    choose_frames,
    first_views,
    fit_world_frame,
    stand_where,
)
from extrap_train.reconstruction.map_files import (
    load_input_seconds,
    load_map,
    load_steps,
    save_input_seconds,
    save_view,
    view_bytes,
)
from extrap_train.reconstruction.planner import Query, expected_order, orbit_queries
from extrap_train.reconstruction.symmetry import Symmetry
from extrap_train.reconstruction.viewer import CloudViewer
from extrap_train.store import Outcome
from extrap_train.store.digests import file_digest
from extrap_train.store.manifest import claim
from extrap_train.tasks.completion_results import Completed, write_completed
from extrap_train.tasks.mirrored_inputs import mirror_inputs
from extrap_train.tasks.scene_inputs import (
    open_sequence,
    require_space,
    required_scene,
    result_folder,
    scene_manifest,
)
from extrap_train.tasks.scene_model import (
    UsedWeights,
    device_of,
    model_options,
    named_weights,
    scene_generator,
    trained_model,
)
from extrap_train.terminal import progress, terminal
from extrap_train.views import stack_cameras, stack_poses

_NOT_PART_OF_THE_MAP = (
    "dry_run",
    "viewer",
    "host",
    "port",
    "held_out",
    "splats",
    "confidence.votes",
    "confidence.least_confidence",
    "depth_network",
)
"""May differ on resume: what is made of the map once it is whole, and where weights lie."""

Watch = Callable[[GlobalMap], None]
"""Called with the map before the first new view, after each, and once all are there."""


@dataclass(frozen=True)
class _Job:
    """A scene and what is to be made of it."""

    config: TrainConfig
    sequence: FrameSequence
    truth: SyntheticScene | None
    folder: Path
    inputs: list[int]
    world: WorldFrame
    used: UsedWeights | None
    """None where the views are rendered."""

    @property
    def photographs(self) -> list[Frame]:
        """The input frames."""
        return [self.sequence.frames[i] for i in self.inputs]

    @property
    def weights(self) -> dict[str, str]:
        """Digests of the weights."""
        weights = {} if self.used is None else self.used.inputs()
        if self.depth_network is not None:
            weights["complete.depth_network"] = file_digest(self.depth_network)
        return weights

    @property
    def depth_network(self) -> Path | None:
        """Weights that give generated views their depth, if not the source does."""
        path = self.config.complete.depth_network
        return None if path is None else Path(path)


def run(config: TrainConfig, watch: Watch | None = None) -> Outcome:
    """Complete a scene; a second run resumes after the last whole view, or says that it is done.

    `watch` takes the place of the viewer. What it raises ends the run, which keeps its views.
    """
    job = _open_job(config)
    console = terminal()
    manifest = scene_manifest(config, job.photographs, job.weights, _map_options(config))
    with claim(job.folder, manifest, resume=config.resume) as result:
        if not result.is_reused:
            result.begin()
        return Outcome(job.folder, _run(job, console, watch))


def _open_job(config: TrainConfig) -> _Job:
    scene = required_scene(config)
    if _is_generated(config):
        named_weights(config)  # refused before cameras are estimated, which may take minutes
    if config.complete.splats.spz:
        require_gsply()
    options = config.data if isinstance(config.data, SyntheticConfig) else SyntheticConfig()
    sequence = open_sequence(config)
    truth = None
    if scene.startswith(SYNTHETIC_SCHEME):
        truth = build_scene(sequence.category, int(sequence.name), options.seed)
    elif config.complete.generator == "exact":
        raise InputError("complete.generator=exact renders: it needs scene=synthetic:…")
    if config.complete.depth_network is not None:
        load_depth_network(Path(config.complete.depth_network))  # before anything is begun
    inputs = choose_frames(
        sequence.frames, config.inputs, config.input_frames, config.complete.draw, config.seed
    )
    inputs = _readable(config, sequence, inputs)
    cameras = [sequence.frames[i].camera for i in inputs]
    check_cameras(cameras, [sequence.frames[i].name for i in inputs])
    _check_category(config, sequence)
    folder = result_folder(config, f"{sequence.category}_{sequence.name}")
    used = UsedWeights.of(config) if _is_generated(config) else None
    return _Job(
        config, sequence, truth, folder, inputs, fit_world_frame(stack_poses(cameras)), used
    )


def _readable(config: TrainConfig, sequence: FrameSequence, inputs: list[int]) -> list[int]:
    """The inputs without those whose files cannot be read; InputError if named, or too many."""
    frames = [sequence.frames[index] for index in inputs]
    photographs = [frame for frame in frames if frame.files]  # others are rendered
    reasons: list[str] = []
    depth = isinstance(config.depth, DatasetDepthConfig)
    readable = {view.name for view in load_readable(photographs, reasons, depth=depth)}
    if reasons and config.input_frames:
        raise InputError(reasons[0])
    part = replace(sequence, frames=frames, left_out=())
    require_few_unusable(reasons, part, f"scene {config.scene}: inputs")
    return [i for i, f in zip(inputs, frames, strict=True) if f.name in readable or not f.files]


def _check_category(config: TrainConfig, sequence: FrameSequence) -> None:
    """A model does not generate views of another category unasked."""
    own, chosen = sequence.category, config.category.name
    if own in (NO_CATEGORY, chosen):
        return
    if config.weights is None and config.complete.generator == "model":
        raise InputError(
            f"scene {config.scene!r} is of category {own}, but category={chosen} would generate it "
            f"with its newest model: give category={own}, or name the model, weights=FOLDER or base"
        )
    terminal().print(f"the scene is of category {own}, not {chosen}")


def _run(job: _Job, console: Console, watch: Watch | None) -> bool:
    """Whether every view was there already."""
    pipeline = _pipeline(job)
    scene_map = _start_map(job, pipeline, console)
    queries = _queries(job, scene_map)
    # The same plan, and the same mirror, for a run that resumes.
    start = replace(scene_map, views=scene_map.views[: len(job.inputs)])
    order = expected_order(start, queries)
    draw_plan(start, order, job.folder / "plan.png")
    console.print(_plan_text(scene_map, order))
    if job.config.complete.dry_run:
        console.print(f"plan: {job.folder / 'plan.png'}; nothing was generated")
        return False
    symmetries: tuple[Symmetry, ...] = ()
    if job.config.complete.symmetry and _is_generated(job.config):
        symmetries, mirrored = mirror_inputs(start, job.photographs, console)
        pipeline = pipeline.with_mirrored(mirrored)
    missing = _count_missing(scene_map, queries)
    require_space(job.folder, missing * view_bytes(pipeline.generator.warp_size))
    with _viewer(job, console) if watch is None else nullcontext(watch) as show:
        show(scene_map)
        with advise_on_sampling_memory(1, job.config.trainer):
            scene_map = _complete_map(job, scene_map, queries, pipeline, show)
        steps = load_steps(job.folder / "map", len(scene_map))
        seconds = {
            "inputs": load_input_seconds(job.folder / "map"),
            "views": sum(sum(step.seconds.values()) for step in steps),
        }
        done = Completed(scene_map, steps, job.world, job.truth, seconds, symmetries)
        write_completed(done, job.config, job.sequence, pipeline, job.used, job.folder, console)
    return not missing


def _count_missing(scene_map: GlobalMap, queries: Sequence[Query]) -> int:
    """How many of the queries the map does not have yet."""
    there = {view.view.name for view in scene_map.views}
    return sum(query.name not in there for query in queries)


def _pipeline(job: _Job) -> CompletionPipeline:
    config = job.config
    if config.complete.generator == "exact":
        assert job.truth is not None
        scene = job.truth
        return CompletionPipeline(
            ExactGenerator(scene, config.complete.exact_size, job.world),
            ExactDepth(scene, job.world),
            config.complete,
            config.seed,
        )
    generator = scene_generator(config, trained_model(config).to(device_of(config)))
    source = depth_source(source_of_generated(config.depth))
    predictor = None
    if job.depth_network is not None:
        predictor = NetworkDepth(load_depth_network(job.depth_network), source)
    return CompletionPipeline(generator, source, config.complete, config.seed, predictor)


def _start_map(job: _Job, pipeline: CompletionPipeline, console: Console) -> GlobalMap:
    """What an earlier run left, or the inputs, measured and saved."""
    folder = job.folder / "map"
    scene_map = load_map(folder, job.config.complete.tolerance)
    if len(scene_map) >= len(job.inputs):
        console.print(f"{folder}: {len(scene_map)} views were made before and are used again")
        return scene_map
    started = time.perf_counter()
    size = pipeline.generator.warp_size
    require_space(job.folder, len(job.inputs) * view_bytes(size))
    source = depth_source(job.config.depth)
    brought = source.image_size is None
    photographs = [frame.load(depth=brought) for frame in job.photographs]
    check_poses(photographs)
    views, confidences = first_views(photographs, source, job.world, size)
    scene_map = map_of_inputs(views, confidences, job.config.complete.tolerance)
    save_input_seconds(time.perf_counter() - started, folder)
    for index, view in enumerate(scene_map.views):
        save_view(view, None, folder, index)
    return scene_map


def _map_options(config: TrainConfig) -> dict[str, Any]:
    """The options of this task that a map depends on."""
    complete_options = {
        f"complete.{key}": value
        for key, value in dotted(asdict(config.complete)).items()
        if not f"{key}.".startswith(tuple(f"{name}." for name in _NOT_PART_OF_THE_MAP))
    }
    return complete_options | (model_options(config) if _is_generated(config) else {})


def _is_generated(config: TrainConfig) -> bool:
    return config.complete.generator != "exact"


def _queries(job: _Job, scene_map: GlobalMap) -> list[Query]:
    given = stack_cameras([view.camera for view in scene_map.views[: len(job.inputs)]])
    if job.config.complete.poses == "orbit":
        return orbit_queries(given, np.radians(job.config.complete.step_deg))
    size = scene_map.views[0].camera.width
    others = [frame for i, frame in enumerate(job.sequence.frames) if i not in job.inputs]
    queries = [Query(frame.name, job.world.inside(frame.camera.squared(size))) for frame in others]
    return [q for q in queries if not stand_where(q.camera, given, np.zeros(3)).any()]


def _plan_text(scene_map: GlobalMap, order: list[Query]) -> str:
    there = {view.view.name for view in scene_map.views}
    names = ", ".join(query.name for query in order if query.name not in there)
    return (
        f"inputs: {', '.join(v.view.name for v in scene_map.views if v.origin.kind == 'given')}\n"
        + (f"views to make, in about this order (coverage decides): {names or 'none is left'}")
    )


@contextmanager
def _viewer(job: _Job, console: Console) -> Iterator[Watch]:
    """The page, where it is wanted; once all is done it stays until its visitor ends it."""
    options = job.config.complete
    if not options.viewer:
        yield lambda scene_map: None
        return
    with CloudViewer(options.port, options.confidence.votes, options.host) as viewer:
        console.print(f"viewer: {viewer.url}")
        yield viewer.show
        if sys.stdin.isatty():
            input("the scene is complete and written; Enter closes the viewer ")


def _complete_map(
    job: _Job,
    scene_map: GlobalMap,
    queries: list[Query],
    pipeline: CompletionPipeline,
    show: Watch,
) -> GlobalMap:
    folder = job.folder / "map"
    left = _count_missing(scene_map, queries)
    with progress("completing", left, "views") as bar:

        def on_step(grown: GlobalMap, added: MapView, step: Step) -> None:
            save_view(added, step, folder, len(grown) - 1)
            bar.advance()
            show(grown)

        scene_map = fuse_depths(complete(scene_map, queries, pipeline, on_step))
    show(scene_map)
    return scene_map
