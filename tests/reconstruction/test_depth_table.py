"""What the depth of generated views and what they are generated from are worth to the completed
scene, and how good depth and pictures are.

`python -m pytest -s -m slow tests/reconstruction/test_depth_table.py` prints the tables of
docs/completion.md: six categories, captures of another seed than any that a model was trained or a
default chosen on, three one-sided inputs with exact depth, pictures of the packaged models.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from extrap_train.config import CompletionConfig, StereoConfig, SyntheticConfig
from extrap_train.data.scene_spec import open_scene
from extrap_train.data.sequences import Frame
from extrap_train.data.synthetic import SyntheticScene, build_scene, render, trace
from extrap_train.depth.stereo import PlaneSweepStereo
from extrap_train.diffusion.generator import DiffusionGenerator
from extrap_train.geometry.cameras import WorldFrame
from extrap_train.geometry.viewpoints import directions_from, scene_center
from extrap_train.metrics import psnr, squeeze_lpips
from extrap_train.reconstruction.cloud import cloud_of
from extrap_train.reconstruction.completion import (
    CompletionPipeline,
    complete,
    map_of_inputs,
    with_masks,
)
from extrap_train.reconstruction.depth_prediction.inference import (
    DepthPredictor,
    PredictedDepth,
)
from extrap_train.reconstruction.exact import ExactDepth
from extrap_train.reconstruction.fusion import fuse_depths
from extrap_train.reconstruction.global_map import GENERATED, GlobalMap, MapView, prior_of
from extrap_train.reconstruction.inputs import choose_frames, first_views, fit_world_frame
from extrap_train.reconstruction.map_scores import cloud_scores
from extrap_train.reconstruction.planner import orbit_queries
from extrap_train.reconstruction.symmetry import find_symmetries, mirrored_photographs
from extrap_train.tasks.completion_results import SUBDIVIDE
from extrap_train.tasks.scene_model import open_model
from extrap_train.views import View, stack_cameras, stack_poses
from tests.reconstruction.pictures_from_behind import (
    Distance,
    pictures_without_model,
    score_pictures,
)

CATEGORIES = ("apple", "book", "chair", "cup", "hydrant", "teddybear")
CAPTURES = SyntheticConfig(seed=917, frames=24, image_size=128)
NUMBERS = (4, 5, 6, 7)
WITHIN = 0.02
ANGLES_DEG = (60, 110, 180)
BEHIND_DEG = 90


@dataclass(frozen=True)
class Capture:
    """A scene with its inputs in the map."""

    scene: SyntheticScene
    world: WorldFrame
    inputs: GlobalMap
    generator: DiffusionGenerator

    @classmethod
    def open(cls, category: str, number: int, *, is_exact: bool = True) -> "Capture":
        """With exact depth of the inputs, or stereo's."""
        scene = build_scene(category, number, CAPTURES.seed)
        frames = open_scene(f"synthetic:{category}/{number:04d}", CAPTURES).frames
        chosen: list[Frame] = [frames[i] for i in choose_frames(frames, 3, (), "one_sided", 0)]
        world = fit_world_frame(stack_poses([frame.camera for frame in chosen]))
        model = open_model(f"ours-{category}")
        generator = DiffusionGenerator(model, model.config.sampler)
        photographs = [frame.load() for frame in chosen]
        source = ExactDepth(scene, world) if is_exact else PlaneSweepStereo(StereoConfig())
        size = generator.warp_size
        views, sure = first_views(photographs, source, world, size)
        masks = [photo.squared(size).mask for photo in photographs]
        inputs = with_masks(map_of_inputs(views, sure, CompletionConfig().tolerance), masks)
        return cls(scene, world, inputs, generator)

    def truth(self, view: View) -> tuple[torch.Tensor, torch.Tensor]:
        """Depth in the map's unit, and the object's mask."""
        depth, mask = trace(self.scene, self.world.outside(view.camera))
        return depth / self.world.unit, mask > 0.5

    def picture(self, view: View) -> torch.Tensor:
        """What a camera there would have taken."""
        return render(self.scene, self.world.outside(view.camera)).image

    def completed(
        self,
        predictor: DepthPredictor | None,
        references: str = "photographs",
        mirrored: tuple[MapView, ...] = (),
    ) -> GlobalMap:
        options = CompletionConfig(references=references)
        stereo = PlaneSweepStereo(StereoConfig())
        pipeline = CompletionPipeline(self.generator, stereo, options, 0, predictor)
        pipeline = pipeline.with_mirrored(mirrored)
        queries = orbit_queries(self.inputs.cameras, np.radians(30))
        return complete(self.inputs, queries, pipeline, lambda *_: None)

    def scores(self, known: GlobalMap) -> dict[str, float]:
        cloud = cloud_of(known, votes=True, subdivide=SUBDIVIDE)
        cloud = cloud[cloud.confidence >= CompletionConfig().confidence.least_confidence]
        return cloud_scores({"": cloud}, self.scene, self.world)[""]


@dataclass(frozen=True)
class ExactPredictor:
    """The oracle: true depth, whatever the picture shows."""

    capture: Capture

    def __call__(self, known: GlobalMap, picture: View, indices: Sequence[int]) -> PredictedDepth:
        depth, _ = self.capture.truth(picture)
        prior = prior_of(known, picture.camera, indices)
        return PredictedDepth(depth, (depth > 0).float(), (prior.depth / depth - 1).abs() < WITHIN)


@dataclass(frozen=True)
class GeneratedView:
    """One generated view against the truth."""

    view: MapView
    angle_deg: float
    """To the nearest input."""
    depth: torch.Tensor
    hidden: torch.Tensor
    """The object's pixels that no input shows."""

    def errors(self) -> np.ndarray:
        """Relative error and confidence of the hidden pixels' depth."""
        error = torch.where(self.view.depth > 0, (self.view.depth / self.depth - 1).abs(), 1)
        return torch.stack([error, self.view.confidence])[:, self.hidden].numpy()


def generated_views(capture: Capture, known: GlobalMap) -> list[GeneratedView]:
    center = scene_center(known.cameras)
    towards = directions_from(capture.inputs.cameras, center)
    found = []
    for view in known.views:
        if view.origin.kind != GENERATED:
            continue
        direction = directions_from(stack_cameras([view.camera]), center)[0]
        angle_deg = float(np.degrees(np.arccos((towards @ direction).max().clip(-1, 1))))
        depth, mask = capture.truth(view.view)
        hidden = mask & ~shown_by(capture.inputs, replace(view.view, depth=depth))
        found.append(GeneratedView(view, angle_deg, depth, hidden))
    return found


def scores_from_behind(
    capture: Capture, maps: dict[str, GlobalMap], lpips: Distance
) -> list[dict[str, str | float]]:
    """`score_pictures` of the views of some maps, all at the same cameras, that are at least
    `BEHIND_DEG` from every input, and of what needs no model.
    """
    rows = []
    for made in generated_views(capture, maps["without"]):
        if made.angle_deg >= BEHIND_DEG:
            like = made.view.view
            pictures = {name: view_named(known, like.name) for name, known in maps.items()}
            pictures |= pictures_without_model(capture.inputs, like)
            rows += score_pictures(capture.scene, capture.world, pictures, lpips)
    return rows


def view_named(known: GlobalMap, name: str) -> View:
    """The view of the map that has this name."""
    return next(view.view for view in known.views if view.view.name == name)


def shown_by(known: GlobalMap, view: View) -> torch.Tensor:
    """Pixels of the view's surface that some view of the map shows."""
    _, added = known.added(view, torch.ones_like(view.depth), known.views[0].origin)
    return ~added.fresh


@pytest.mark.slow
@pytest.mark.parametrize("is_exact", [False, True], ids=["stereo", "exact"])
def test_what_exact_depth_at_birth_is_worth(is_exact: bool) -> None:
    rows, errors = [], []
    for category in CATEGORIES:
        for number in NUMBERS:
            capture = Capture.open(category, number)
            known = capture.completed(ExactPredictor(capture) if is_exact else None)
            found = capture.scores(known)
            rows.append([found[name] for name in ("accuracy", "completeness", "f_score")])
            errors += [(x.angle_deg, x.errors()) for x in generated_views(capture, known)]
            print(f"\n{category} {number}: " + " / ".join(f"{value:.3f}" for value in rows[-1]))
    means = np.mean(rows, 0)
    print("mean: " + " / ".join(f"{value:.3f}" for value in means))
    for low, high in pairwise((0, *ANGLES_DEG)):
        within = [pixels for angle_deg, pixels in errors if low < angle_deg <= high]
        if within:
            error, confidence = np.concatenate(within, 1)
            said = confidence >= 0.5
            print(
                f"{low}° to {high}°: median error {np.median(error):.4f}, within 2 % "
                f"{(error < WITHIN).mean():.2f}; of the {said.mean():.2f} with a confidence of at "
                f"least .5, {(error[said] < WITHIN).mean():.2f}"
            )
    if is_exact:
        assert means[2] > 0.9


@pytest.mark.slow
def test_pictures_generated_from_the_photographs_alone_show_more_of_the_object() -> None:
    """Each generated view again, from the photographs and from generated views, too: PSNR of the
    object's pixels that no input shows."""
    rows = []
    for category in CATEGORIES:
        for number in NUMBERS[:2]:
            capture = Capture.open(category, number)
            for references in ("photographs", "all"):
                known = capture.completed(None, references)
                score = capture.scores(known)["f_score"]
                print(f"\n{category} {number} from {references}: F-score {score:.3f}", flush=True)
                for made in generated_views(capture, known):
                    if not made.hidden.any():
                        continue
                    error = (made.view.view.image - capture.picture(made.view.view)) ** 2
                    db = -10 * np.log10(float(error.mean(0)[made.hidden].mean()))
                    rows.append((references, made.angle_deg, db, score))
    frame = pd.DataFrame(rows, columns=["references", "angle_deg", "psnr", "f_score"])
    frame["to_deg"] = pd.cut(frame["angle_deg"], [0, *ANGLES_DEG], labels=ANGLES_DEG)
    means = frame.pivot_table("psnr", "to_deg", "references", observed=True)
    print(means.round(2), frame.groupby("references")["f_score"].mean().round(3), sep="\n")
    assert means["photographs"][180] > means["all"][180]


@pytest.mark.slow
@pytest.mark.parametrize("is_exact", [True, False], ids=["exact", "stereo"])
def test_mirrored_photographs_close_the_scene(is_exact: bool, shared: Path) -> None:
    """Completed with and without the object's symmetry, depths fused, depth of the inputs exact or
    stereo's: scores of the cloud, depth and picture of the object's pixels that no input shows, and
    pictures of the object from behind.
    """
    lpips = squeeze_lpips(str(shared / "weights/lpips_squeeze.pt"))
    rows, behind = [], []
    for category in CATEGORIES:
        for number in NUMBERS:
            capture = Capture.open(category, number, is_exact=is_exact)
            found = find_symmetries(capture.inputs)
            mirrored = mirrored_photographs(capture.inputs, found)
            maps: dict[str, GlobalMap] = {}
            for name, views in (("without", ()), ("mirrored", mirrored)):
                if name == "mirrored" and not found:
                    rows.append(rows[-1] | {"inputs": name})
                    maps[name] = maps["without"]
                    continue
                maps[name] = known = fuse_depths(capture.completed(None, mirrored=views))
                made = [x for x in generated_views(capture, known) if x.hidden.any()]
                errors = np.concatenate([x.errors()[0] for x in made])
                squares = [
                    (x.view.view.image - capture.picture(x.view.view))[:, x.hidden].square().mean()
                    for x in made
                ]
                wholes = [
                    psnr(x.view.view.image[None], capture.picture(x.view.view)[None]) for x in made
                ]
                row = {
                    "median error": float(np.median(errors)),
                    "within": float((errors < WITHIN).mean()),
                    "psnr": float(np.mean(-10 * np.log10(squares))),
                    "psnr of the picture": float(np.mean(wholes)),
                }
                rows.append(
                    {"category": category, "inputs": name, "planes": len(found)}
                    | row
                    | capture.scores(known)
                )
                print(f"\n{category} {number}", rows[-1], flush=True)
            behind += [
                {"capture": f"{category} {number}"} | row
                for row in scores_from_behind(capture, maps, lpips)
            ]
    table = pd.DataFrame(rows)
    print(table.groupby(["category", "inputs"]).mean().round(3).to_string())
    means = table.drop(columns="category").groupby("inputs").mean()
    print(means.round(4).T.to_string())
    pictures = pd.DataFrame(behind).groupby(["picture", "capture"]).mean()
    print(pictures.groupby("picture").mean().round(3).to_string())
    for name in ("without", "nearest photograph", "inpainted warp"):
        gain = (pictures.loc["mirrored"] - pictures.loc[name]).dropna(axis=1)
        half = 2 * gain.std() / len(gain) ** 0.5
        print(f"mirrored against {name}:", gain.mean().round(3).to_dict(), half.round(3).to_dict())
    assert means["f_score"]["mirrored"] > means["f_score"]["without"] + 0.02


@pytest.mark.slow
def test_fusion_brings_depths_nearer_to_the_truth() -> None:
    """The same maps before and after it: scores of the cloud, and errors of the hidden pixels."""
    rows = []
    for category in CATEGORIES:
        for number in NUMBERS[:2]:
            capture = Capture.open(category, number)
            known = capture.completed(None)
            for depths, views in (("as they came", known), ("fused", fuse_depths(known))):
                errors = np.concatenate([x.errors()[0] for x in generated_views(capture, views)])
                row = capture.scores(views) | {"within": float((errors < WITHIN).mean())}
                rows.append({"depths": depths, "median error": float(np.median(errors)), **row})
                print(f"\n{category} {number}", rows[-1], flush=True)
    means = pd.DataFrame(rows).groupby("depths").mean()
    print(means.round(4).T)
    assert means["f_score"]["fused"] > means["f_score"]["as they came"]
