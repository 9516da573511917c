"""What a completed scene leaves behind: cloud, views, models, pictures and `summary.json`."""

import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from extrap_train.config import TrainConfig
from extrap_train.data.sequences import Frame, FrameSequence
from extrap_train.data.square_frames import load_held_out
from extrap_train.data.synthetic import SyntheticScene
from extrap_train.figures import colour_depth, draw_contact_sheet, error_map, mark_holes
from extrap_train.gaussians.fit import Diverged
from extrap_train.geometry.cameras import WorldFrame
from extrap_train.metrics import lpips_or_reason, psnr, quantised, ssim
from extrap_train.reconstruction.cloud import PointCloud, cloud_of
from extrap_train.reconstruction.cloud_pictures import draw_growth, draw_turntable
from extrap_train.reconstruction.completion import CompletionPipeline, Step
from extrap_train.reconstruction.export import write_cloud, write_colmap, write_views
from extrap_train.reconstruction.global_map import GENERATED, GIVEN, GlobalMap, MapView, prior_of
from extrap_train.reconstruction.inputs import stand_where
from extrap_train.reconstruction.map_scores import (
    cloud_scores,
    coverage_of,
    drift,
    view_consistency,
)
from extrap_train.reconstruction.mesh import write_mesh
from extrap_train.reconstruction.planner import REFERENCES
from extrap_train.reconstruction.symmetry import Symmetry
from extrap_train.runs import provenance
from extrap_train.store.records import write_summary
from extrap_train.tasks.scene_inputs import photograph_digests
from extrap_train.tasks.scene_model import UsedWeights, frames_learnt
from extrap_train.tasks.splats import write_fitted_splats
from extrap_train.terminal import track
from extrap_train.views import Camera, stack_cameras

_NOTHING_SHARE = 0.02
"""Share of the cloud's points: with fewer, the generated views added next to nothing."""
_NO_MESH = "the views show no surface near the point that the cameras look at"
SUBDIVIDE = 3
"""Points that a pixel of the cloud becomes along each axis."""


@dataclass(frozen=True)
class Completed:
    """A map that is whole, and how it came about."""

    scene_map: GlobalMap
    steps: Sequence[Step]
    world: WorldFrame
    truth: SyntheticScene | None
    seconds: dict[str, float]
    """Seconds spent on the inputs and the views, whichever run made them."""
    symmetries: Sequence[Symmetry] = ()
    """The object's, that the photographs were mirrored in."""


def write_completed(
    done: Completed,
    config: TrainConfig,
    sequence: FrameSequence,
    pipeline: CompletionPipeline,
    used: UsedWeights | None,
    folder: Path,
    console: Console,
) -> None:
    """Write everything, `summary.json` last."""
    started = time.perf_counter()
    confidence = config.complete.confidence
    cloud = cloud_of(done.scene_map, votes=confidence.votes, subdivide=SUBDIVIDE)
    cloud = cloud[cloud.confidence >= confidence.least_confidence]
    outside = replace(cloud, points=done.world.points_outside(cloud.points))
    writers: list[Callable[[], object]] = [
        lambda: write_cloud(outside, folder / "cloud.ply"),
        lambda: write_views(done.scene_map, done.world, folder),
        lambda: write_colmap(done.scene_map, done.world, outside, folder),
        lambda: draw_growth(done.scene_map, cloud, folder / "growth.png"),
        lambda: draw_turntable(done.scene_map, cloud, folder / "turntable.mp4"),
        lambda: _draw_views(done.scene_map, folder / "views.png"),
    ]
    for write in track(writers, "exporting", len(writers), "results"):
        write()
    faces = write_mesh(done.scene_map, done.world, cloud, folder / "mesh.ply")
    done.seconds["export"] = time.perf_counter() - started
    started = time.perf_counter()
    splats, no_splats = _fit_splats(done, config, folder)
    done.seconds["splats"] = time.perf_counter() - started
    started = time.perf_counter()
    held_out, missing = _compare_held_out(done, config, sequence, pipeline, folder)
    metrics = _metrics(done, cloud)
    done.seconds["measure"] = time.perf_counter() - started
    given = {view.view.name for view in done.scene_map.given}
    summary = {
        "generated_with": asdict(used) if used else "exact renderings",
        "photographs": photograph_digests(f for f in sequence.frames if f.name in given),
        "views": {GIVEN: len(given), GENERATED: len(done.scene_map) - len(given)},
        "points": len(cloud),
        "points_of_generated_views": int((cloud.view >= len(given)).sum()),
        "mesh_faces": faces,
        "metrics": metrics,
        "held_out": held_out,
        "splats": splats,
        "missing": missing | no_splats | ({} if faces else {"mesh": _NO_MESH}),
        "symmetries": [_evidence(symmetry) for symmetry in done.symmetries],
        "loop": drift(done.steps, done.scene_map),
        "consistency_db": view_consistency(done.scene_map),
        "sphere_coverage": coverage_of(done.scene_map),
        "seconds": done.seconds,
        "steps": [asdict(step) for step in done.steps],
        "provenance": provenance(config, {"scene": config.scene or ""}),
    }
    write_summary(folder, summary)
    console.print(f"generated with {used or 'exact renderings of the scene'}")
    _print_what_was_added(done, summary, config, console)
    _print_summary(summary, console)
    console.print(f"pictures: {folder / 'growth.png'}\nresult: {folder}")


def _evidence(symmetry: Symmetry) -> dict[str, float]:
    """Shares of the object's points, mirrored: where they fall."""
    return {name: float(getattr(symmetry, name)) for name in ("agreement", "contradiction", "gain")}


def _print_what_was_added(
    done: Completed, summary: dict[str, Any], config: TrainConfig, console: Console
) -> None:
    """Say where the generated views added next to nothing, and what became of doubtful ones."""
    confidence = config.complete.confidence
    doubted = [s.name for s in done.steps if s.agreement < confidence.least_agreement]
    if doubted:
        what = (
            "what they show for the first time was left out of the map"
            if confidence.reject
            else "they were kept all the same (complete.confidence.reject=false)"
        )
        console.print(
            f"{len(doubted)} of {len(done.steps)} views contradict the photographs "
            f"({', '.join(doubted[:3])}{', …' if len(doubted) > 3 else ''}): {what}"
        )
    added, points = summary["points_of_generated_views"], summary["points"]
    if done.steps and added < _NOTHING_SHARE * points:
        console.print(
            f"the generated views added next to nothing ({added} of {points} "
            "points): the photographs show nearly everything already; fewer inputs from one side "
            "(complete.draw=one_sided inputs=3) leave more to complete"
        )
    elif not done.steps:
        console.print("no view was generated: the photographs already stand all around")


def _fit_splats(
    done: Completed, config: TrainConfig, folder: Path
) -> tuple[dict[str, float] | None, dict[str, str]]:
    """The fitted Gaussians' numbers, or why there are none: the rest of the scene is whole."""
    options = config.complete.splats
    if not options.fit:
        return None, {}
    try:
        return write_fitted_splats(done.scene_map, done.world, options, config.seed, folder), {}
    except Diverged as error:
        return None, {"splats": str(error)}


def _metrics(done: Completed, cloud: PointCloud) -> dict[str, dict[str, float]] | None:
    """3-D scores where the truth is known: of the inputs alone, and of everything."""
    if done.truth is None:
        return None
    only = replace(done.scene_map, views=done.scene_map.given)
    inputs = cloud_of(only, votes=False, subdivide=SUBDIVIDE)
    return cloud_scores({"inputs": inputs, "completed": cloud}, done.truth, done.world)


def _draw_views(scene_map: GlobalMap, path: Path) -> None:
    draw_contact_sheet(
        {
            "view": torch.stack([view.view.image for view in scene_map.views]),
            "depth": colour_depth(torch.stack([view.depth for view in scene_map.views])),
            "confidence": torch.stack([v.confidence.expand(3, -1, -1) for v in scene_map.views]),
            "new points": torch.stack([v.fresh.float().expand(3, -1, -1) for v in scene_map.views]),
        },
        path,
    )


def _compare_held_out(
    done: Completed,
    config: TrainConfig,
    sequence: FrameSequence,
    pipeline: CompletionPipeline,
    folder: Path,
) -> tuple[dict[str, float | None] | None, dict[str, str]]:
    """Views generated at the poses of photographs that were no inputs, against these."""
    given = done.scene_map.given
    known = {view.view.name for view in given} | set(frames_learnt(config, sequence.frames))
    frames = _held_out(given, done.world, sequence, known)[: config.complete.held_out]
    if not frames or config.complete.generator == "exact":
        return None, {}
    size = pipeline.generator.image_size
    truth = [view.squared(size) for view in load_held_out(frames)]
    if not truth:
        return None, {}
    cameras = [done.world.inside(view.camera) for view in truth]
    made, warps, masks = [], [], []
    only = GlobalMap(done.scene_map.tolerance, given)
    posed = zip(truth, cameras, strict=True)
    for view, camera in track(posed, "comparing with held-out photographs", len(truth), "views"):
        near = [done.scene_map.views[i].view for i in _elsewhere(done.scene_map, camera)]
        query = stack_cameras([camera])
        generated = pipeline.generator.generate(near, query, [view.name], config.seed)
        made.append(generated.images[0])
        seen = prior_of(only, camera, only.nearest(camera, REFERENCES))
        warps.append(mark_holes(seen.image[None], seen.mask.float()[None])[0])
        masks.append(seen.mask.float())
    images, photos = quantised(torch.stack(made)), quantised(torch.stack([v.image for v in truth]))
    draw_contact_sheet(
        {
            "warp of the inputs": torch.stack(warps),
            "generated": images,
            "photograph": photos,
            "error": error_map(images, photos),
        },
        folder / "held_out.png",
    )
    mask = torch.stack(masks)
    scores: dict[str, float | None] = {
        "views": float(len(truth)),
        "psnr": float(psnr(images, photos).mean()),
        "psnr_masked": float(psnr(images, photos, mask).nanmean()),
        "ssim": float(ssim(images, photos).mean()),
        "lpips": None,
    }
    distance, missing = lpips_or_reason(config.validation.lpips_weights)
    if distance is not None:
        scores["lpips"] = float(distance(images, photos).mean())
    return scores, missing


def _held_out(
    given: Sequence[MapView], world: WorldFrame, sequence: FrameSequence, known: Collection[str]
) -> list[Frame]:
    """The frames that are not known, and were not taken from where an input was."""
    inputs = stack_cameras([world.outside(view.camera) for view in given])
    center = world.center.double().numpy()
    return [
        frame
        for frame in sequence.frames
        if frame.name not in known and not stand_where(frame.camera, inputs, center).any()
    ]


def _elsewhere(scene_map: GlobalMap, camera: Camera) -> list[int]:
    """The nearest views that do not stand where the camera does: `complete.poses=capture` has made
    views there, which would be generated from themselves.
    """
    there = stand_where(camera, scene_map.cameras, np.zeros(3))
    return [i for i in scene_map.nearest(camera, len(scene_map)) if not there[i]][:REFERENCES]


def _print_summary(summary: dict[str, Any], console: Console) -> None:
    if summary["metrics"]:
        names = ("accuracy", "completeness", "f_score")
        table = Table("", *names, title="cloud against the truth, at 2 % of the object's size")
        for which, row in summary["metrics"].items():
            table.add_row(which, *(f"{row[name]:.3f}" for name in names))
        console.print(table)
    if summary["held_out"]:
        scores = {k: v for k, v in summary["held_out"].items() if v is not None}
        count = scores.pop("views")
        numbers = ", ".join(f"{name} {score:.3f}" for name, score in scores.items())
        console.print(f"{count:.0f} views at held-out photographs (held_out.png): {numbers}")
    if summary["splats"]:
        count, score = summary["splats"]["gaussians"], summary["splats"]["psnr"]
        again = "" if summary["splats"]["seconds"] else ", used again"
        console.print(f"splats: {count:.0f} Gaussians show the views at {score:.2f} dB{again}")
    error = summary["loop"]["largest_error"]
    apart = "the two ways around did not meet"
    if error is not None:
        apart = f"where the two ways around meet, they differ by {error:.1%} of the scene's size"
    console.print(f"loop closure: {apart}")
    for name, reason in summary["missing"].items():
        console.print(f"missing {name}: {reason}")
