"""`task=complete`: from a few posed photographs of a scene to a full turn around it."""

import json
import shutil
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from extrap_train.config import (
    DatasetDepthConfig,
    StereoConfig,
    SyntheticConfig,
    TrainConfig,
    dotted,
    sampler_for,
)
from extrap_train.data.photographs import CATEGORY
from extrap_train.data.scene import SYNTHETIC_SCHEME, open_scene
from extrap_train.data.sequences import Sequence
from extrap_train.data.synthetic import SyntheticScene, build_scene
from extrap_train.depth.build import depth_source
from extrap_train.diffusion.generator import DiffusionGenerator
from extrap_train.diffusion.memory import advice_where_painting_ends
from extrap_train.errors import InputError
from extrap_train.reconstruction.completion import Step, Workshop, complete, map_of_inputs
from extrap_train.reconstruction.exact import ExactDepth, ExactGenerator
from extrap_train.reconstruction.global_map import GlobalMap, MapView
from extrap_train.reconstruction.growth import draw_plan
from extrap_train.reconstruction.inputs import (
    WorldUnit,
    check_cameras,
    choose_frames,
    first_views,
    stand_where,
    world_unit,
)
from extrap_train.reconstruction.map_files import load_map, load_steps, save_step, save_view
from extrap_train.reconstruction.planner import Query, expected_order, orbit_queries
from extrap_train.reconstruction.pose_check import check_poses
from extrap_train.reconstruction.viewer import CloudViewer
from extrap_train.runs import newest_run
from extrap_train.store.atomic import file_lock, write_atomic
from extrap_train.tasks.completed import Completed, write_completed
from extrap_train.tasks.scene_folder import require_same, result_folder
from extrap_train.tasks.scene_inputs import device_of, required_scene, trained_model
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
)
"""May differ on resume: what is made of the map once it is whole."""


@dataclass(frozen=True)
class _Job:
    """A scene and what is to be made of it."""

    config: TrainConfig
    sequence: Sequence
    truth: SyntheticScene | None
    folder: Path
    inputs: list[int]
    unit: WorldUnit


def run(config: TrainConfig) -> Path:
    """Complete a scene; a second run resumes after the last whole view, or says that it is done."""
    job = _job(config)
    console = terminal()
    job.folder.mkdir(parents=True, exist_ok=True)
    taken = f"{job.folder}: another process is completing this scene; wait for it or give run=NAME"
    with file_lock(job.folder / ".lock", taken):
        _run(job, console)
    return job.folder


def _job(config: TrainConfig) -> _Job:
    scene = required_scene(config)
    options = config.data if isinstance(config.data, SyntheticConfig) else SyntheticConfig()
    sequence = open_scene(scene, options)
    truth = None
    if scene.startswith(SYNTHETIC_SCHEME):
        truth = build_scene(sequence.category, int(sequence.name), options.seed)
    elif config.complete.generator == "exact":
        raise InputError("complete.generator=exact renders: it needs scene=synthetic:…")
    inputs = choose_frames(
        sequence.frames, config.inputs, config.input_frames, config.complete.draw, config.seed
    )
    cameras = [sequence.frames[i].camera for i in inputs]
    check_cameras(cameras, [sequence.frames[i].name for i in inputs])
    _check_category(config, sequence)
    folder = result_folder(config, _slug(sequence))
    return _Job(config, sequence, truth, folder, inputs, world_unit(stack_poses(cameras)))


def _check_category(config: TrainConfig, sequence: Sequence) -> None:
    """A category's newest model is not to paint another category unasked."""
    own, chosen = sequence.category, config.category.name
    if own in (CATEGORY, chosen):
        return
    if config.weights is None and config.complete.generator == "model":
        raise InputError(
            f"scene {config.scene!r} is of category {own}, but category={chosen} would paint it "
            f"with its newest model: give category={own}, or name the model, weights=FOLDER or base"
        )
    terminal().print(f"the scene is of category {own}, not {chosen}")


def _slug(sequence: Sequence) -> str:
    return f"{sequence.category}_{sequence.name}"


def _run(job: _Job, console: Console) -> None:
    started = time.perf_counter()
    workshop = _workshop(job)
    known = _started_map(job, workshop, console)
    seconds = {"inputs": time.perf_counter() - started}
    queries = _queries(job, known)
    order = expected_order(known, queries)
    draw_plan(known, order, job.folder / "plan.png")
    console.print(_plan_text(known, order))
    if job.config.complete.dry_run:
        console.print(f"plan: {job.folder / 'plan.png'}; nothing was generated")
        return
    started = time.perf_counter()
    with _viewer(job, known, console) as viewer:
        with advice_where_painting_ends(1, job.config.trainer):
            known = _completed(job, known, queries, workshop, viewer)
        seconds["views"] = time.perf_counter() - started
        steps = load_steps(job.folder / "map", len(known))
        done = Completed(known, steps, job.unit, job.truth, seconds)
        write_completed(done, job.config, job.sequence, workshop, job.folder, console)


def _workshop(job: _Job) -> Workshop:
    config = job.config
    if config.complete.generator == "exact":
        assert job.truth is not None
        scene = job.truth
        return Workshop(
            ExactGenerator(scene, config.complete.exact_size, job.unit),
            ExactDepth(scene, job.unit),
            config.complete,
            config.seed,
        )
    model = trained_model(config).to(device_of(config))
    generator = DiffusionGenerator(model, sampler_for(config.sampler, model.config))
    # A generated view brings no depth along.
    own = config.depth
    source = StereoConfig() if isinstance(own, DatasetDepthConfig) else own
    return Workshop(generator, depth_source(source), config.complete, config.seed)


def _started_map(job: _Job, workshop: Workshop, console: Console) -> GlobalMap:
    """What an earlier run left, or the inputs, measured and saved."""
    folder = job.folder / "map"
    if not job.config.resume:
        shutil.rmtree(folder, ignore_errors=True)
    _note_options(folder / "options.json", _identity(job, workshop))
    known = load_map(folder, job.config.complete.tolerance)
    if len(known) >= len(job.inputs):
        console.print(f"{folder}: {len(known)} views are there already")
        return known
    source = depth_source(job.config.depth)
    brought = source.image_size is None
    photographs = [job.sequence.frames[i].load(depth=brought) for i in job.inputs]
    check_poses(photographs)
    views, confidences = first_views(photographs, source, job.unit, workshop.generator.warp_size)
    known = map_of_inputs(views, confidences, job.config.complete.tolerance)
    for index, view in enumerate(known.views):
        save_view(view, folder, index)
    return known


def _identity(job: _Job, workshop: Workshop) -> dict[str, Any]:
    """The options that a map depends on."""
    config = job.config
    complete_options = {
        f"complete.{key}": value
        for key, value in dotted(asdict(config.complete)).items()
        if not f"{key}.".startswith(tuple(f"{name}." for name in _NOT_PART_OF_THE_MAP))
    }
    exact = config.complete.generator == "exact"
    sampler = config.sampler.over(config.model.sampler)
    if isinstance(workshop.generator, DiffusionGenerator):
        sampler = workshop.generator.sampler
    return {
        "scene": config.scene,
        "data.seed": getattr(config.data, "seed", None),
        "inputs": [job.sequence.frames[i].name for i in job.inputs],
        "depth": asdict(config.depth),
        **complete_options,
        "sampler": asdict(sampler),
        "weights": None if exact else config.weights or str(newest_run(config).model.resolve()),
        "adapter": config.adapter,
        "seed": config.seed,
    }


def _note_options(record: Path, options: dict[str, Any]) -> None:
    if record.is_file():
        require_same(record, options, "start over")
    else:
        write_atomic(record, (json.dumps(options, indent=1) + "\n").encode())


def _queries(job: _Job, known: GlobalMap) -> list[Query]:
    given = stack_cameras([view.camera for view in known.views[: len(job.inputs)]])
    if job.config.complete.poses == "orbit":
        return orbit_queries(given, np.radians(job.config.complete.step_deg))
    size = known.views[0].camera.width
    others = [frame for i, frame in enumerate(job.sequence.frames) if i not in job.inputs]
    queries = [Query(frame.name, job.unit.inside(frame.camera.squared(size))) for frame in others]
    return [q for q in queries if not stand_where(q.camera, given, np.zeros(3)).any()]


def _plan_text(known: GlobalMap, order: list[Query]) -> str:
    there = {view.view.name for view in known.views}
    names = ", ".join(query.name for query in order if query.name not in there)
    return (
        f"inputs: {', '.join(v.view.name for v in known.views if v.origin.kind == 'given')}\n"
        + (f"views to make, in about this order (coverage decides): {names or 'none is left'}")
    )


@contextmanager
def _viewer(job: _Job, known: GlobalMap, console: Console) -> Iterator[CloudViewer | None]:
    """The page, where it is wanted; once all is done it stays until its visitor ends it."""
    options = job.config.complete
    if not options.viewer:
        yield None
        return
    with CloudViewer(options.port, options.confidence.votes, options.host) as viewer:
        viewer.show(known)
        console.print(f"viewer: {viewer.url}")
        yield viewer
        if sys.stdin.isatty():
            input("the scene is complete and written; Enter closes the viewer ")


def _completed(
    job: _Job,
    known: GlobalMap,
    queries: list[Query],
    workshop: Workshop,
    viewer: CloudViewer | None,
) -> GlobalMap:
    folder = job.folder / "map"
    there = {view.view.name for view in known.views}
    left = sum(query.name not in there for query in queries)
    with progress("completing", left, "views") as bar:

        def on_step(grown: GlobalMap, added: MapView, step: Step) -> None:
            save_step(step, folder, len(grown) - 1)
            save_view(added, folder, len(grown) - 1)
            if viewer is not None:
                viewer.show(grown)
            bar.advance()

        return complete(known, queries, workshop, on_step)
