"""The loop on analytic scenes with exact pictures and depth: what is left is geometry."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import scenes
import torch

from extrap_train.config import CompletionConfig, ConfidenceConfig
from extrap_train.data.examples import query_batch
from extrap_train.depth import RELIABLE_CONFIDENCE, DatasetDepth, DepthMap, PointMaps, point_maps_of
from extrap_train.diffusion.generator import GeneratedViews
from extrap_train.errors import InputError
from extrap_train.geometry.mirror import MirrorPlane
from extrap_train.geometry.viewpoints import pairwise_angles, scene_center
from extrap_train.geometry.warp import compute_warp
from extrap_train.reconstruction.cloud import cloud_of
from extrap_train.reconstruction.completion import (
    CompletionPipeline,
    add_view,
    complete,
    map_of_inputs,
    with_masks,
)
from extrap_train.reconstruction.global_map import GENERATED, GlobalMap, Prior, prior_of
from extrap_train.reconstruction.map_files import load_map, save_view
from extrap_train.reconstruction.measurement import Measured, supported
from extrap_train.reconstruction.new_view import propose
from extrap_train.reconstruction.planner import Query, next_query, orbit_queries
from extrap_train.reconstruction.symmetry import Symmetry, mirrored_photographs
from extrap_train.views import Camera, View, stack_cameras

SIZE = 64
MOVED = 12
"""Pixels that a wrong picture is moved aside by."""
SCENE = scenes.Scene((scenes.sphere(0.6), scenes.plane(0.6, (0.0, 1.0, 0.0))))


def photograph(camera: Camera, name: str = "") -> View:
    return View(SCENE.image(camera), camera, SCENE.depth(camera), name=name)


@dataclass(frozen=True)
class TracedGenerator:
    """Exact pictures; those of `wrong` names, asked for with the first seed, are moved aside."""

    wrong: tuple[str, ...] = ()
    stubborn: bool = False

    @property
    def image_size(self) -> int:
        return SIZE

    warp_size = image_size

    def generate(self, references, queries, names, seed=0):
        batch, chosen = query_batch(references, queries, 3, SIZE)
        images = [SCENE.image(batch.camera[i]) for i in range(len(names))]
        for i, name in enumerate(names):
            if name in self.wrong and (seed == 0 or self.stubborn):
                images[i] = images[i].roll(MOVED, -1)
        batch = compute_warp(batch)
        return GeneratedViews(torch.stack(images), batch.camera, batch.warp, chosen)


@dataclass(frozen=True)
class TracedDepth:
    """Depth that belongs to what the picture shows: moved along where the picture is."""

    @property
    def image_size(self) -> None:
        return None

    def depth_map(self, view, neighbours):
        depth = SCENE.depth(view.camera) if view.depth is None else view.depth
        if (view.image - SCENE.image(view.camera).roll(MOVED, -1)).abs().mean() < 0.01:
            depth = depth.roll(MOVED, -1)
        return DepthMap(depth, (depth > 0).float())

    def depth_maps(self, views):
        return [self.depth_map(view, ()) for view in views]

    def point_maps(self, first, second) -> PointMaps:
        one, two = self.depth_map(first, ()), self.depth_map(second, ())
        return point_maps_of(first, one, replace(second, depth=two.depth), two)


@dataclass(frozen=True)
class OneEdge(TracedDepth):
    """Pairs no views that stand more than 40° apart."""

    def point_maps(self, first, second) -> PointMaps:
        cameras = stack_cameras([first.camera, second.camera])
        if pairwise_angles(cameras, scene_center(cameras))[0, 1] > np.radians(40):
            raise InputError("too far apart")
        return super().point_maps(first, second)


@dataclass(frozen=True)
class Wall(TracedDepth):
    """A picture without depth shows a wall before its camera."""

    depth: float

    def depth_map(self, view, neighbours):
        depth = torch.full((SIZE, SIZE), self.depth) if view.depth is None else view.depth
        return DepthMap(depth, (depth > 0).float())


def inputs(*azimuths_deg: float) -> GlobalMap:
    views = [photograph(scenes.orbit_camera(a, size=SIZE), f"photo{a}") for a in azimuths_deg]
    return map_of_inputs(views, [(view.depth > 0).float() for view in views], 0.01)


def completed(known: GlobalMap, generator=None, references="photographs", **confidence):
    options = CompletionConfig(references=references, confidence=ConfidenceConfig(**confidence))
    steps = []
    pipeline = CompletionPipeline(generator or TracedGenerator(), TracedDepth(), options, 0)
    # Queries are planned from the inputs alone, wherever a run was cut.
    queries = orbit_queries(known.cameras[:3], np.radians(30))
    grown = complete(known, queries, pipeline, lambda m, v, step: steps.append(step))
    return grown, steps


def test_two_inputs_above_each_other_are_turned_around_once():
    cameras = [scenes.orbit_camera(30.0, size=SIZE, elevation_deg=e) for e in (5.0, 35.0)]
    queries = orbit_queries(stack_cameras(cameras), np.radians(30))
    names = [query.name for query in queries]
    assert len(names) == len({*names}) == 11


def off_surface(known: GlobalMap, votes: bool = True) -> float:
    """Share of the measured points that lie more than 2 % of the sphere's size off any surface."""
    cloud = cloud_of(known, votes=votes)
    points = cloud.points[cloud.confidence >= RELIABLE_CONFIDENCE]
    distance = torch.minimum((points.norm(dim=-1) - 0.6).abs(), (points[:, 1] - 0.6).abs())
    return float((distance > 0.024).float().mean())


def sphere_completeness(known: GlobalMap) -> float:
    """Share of a band around the sphere that has a point within 5 % of its radius."""
    azimuth = torch.linspace(0, 2 * torch.pi, 181)[:-1]
    band = torch.cat(
        [
            0.6
            * torch.stack([azimuth.cos() * c, torch.full_like(azimuth, s), azimuth.sin() * c], 1)
            for s, c in ((-0.3, 0.954), (0.0, 1.0))
        ]
    )
    near = torch.cdist(band, cloud_of(known, subdivide=2).points).amin(1)
    return float((near < 0.03).float().mean())


@pytest.fixture(scope="module")
def whole():
    return completed(inputs(-30.0, 0.0, 30.0))


def test_a_turn_fills_what_the_inputs_leave_open(whole):
    known, steps = whole
    assert sphere_completeness(inputs(-30.0, 0.0, 30.0)) < 0.7
    assert sphere_completeness(known) > 0.87
    assert off_surface(known) < 0.02
    assert len(steps) == 9
    assert all(step.edges >= 3 and step.attempts == 1 for step in steps)


def test_views_are_generated_from_the_photographs_alone_or_from_all_views(whole):
    photographs = inputs(-30.0, 0.0, 30.0)
    chained, _ = completed(photographs, references="all")
    for known, is_chained in ((whole[0], False), (chained, True)):
        used = [i for view in known.views for i in view.origin.references]
        assert used
        assert (max(used) >= len(photographs)) == is_chained
    # Nothing stands nearer to the first new view than the photographs, whatever is allowed.
    assert chained.views[3].origin.references == whole[0].views[3].origin.references


def test_mirrored_photographs_show_what_is_behind_and_are_no_part_of_the_map():
    known = inputs(-30.0, 0.0, 30.0)
    masks = [(scenes.Scene(SCENE.shapes[:1]).depth(v.camera) > 0).float() for v in known.views]
    plane = MirrorPlane(torch.tensor([0.0, 0.0, 1.0]), torch.tensor(0.0))
    symmetry = Symmetry(plane, torch.ones(()), torch.zeros(()))
    mirrored = mirrored_photographs(with_masks(known, masks), [symmetry])
    asked = []

    @dataclass(frozen=True)
    class Noting(TracedGenerator):
        def generate(self, references, queries, names, seed=0):
            asked.append(list(references))
            return super().generate(references, queries, names, seed)

    options = CompletionConfig()
    pipeline = CompletionPipeline(Noting(), TracedDepth(), options, 0).with_mirrored(mirrored)
    behind = Query("behind", scenes.orbit_camera(180.0, size=SIZE))
    grown, added, step = add_view(known, behind, pipeline)
    shown = [reference.name for reference in asked[0]]
    assert sorted(shown) == sorted(2 * [view.view.name for view in known.views])
    assert asked[0][0] is mirrored[1].view, "the nearest one first"
    assert step.edges == 4, "aligned to mirrored photographs, too"
    assert len(grown) == len(known) + 1
    assert max(added.origin.references) < len(known)


def test_branches_grow_in_turn():
    """Of two queries that are as near and as well covered, the one farther from the newest view."""
    queries = [Query(f"{a:g}", scenes.orbit_camera(a, size=SIZE)) for a in (60.0, -60.0)]
    assert next_query(inputs(-30.0, 0.0, 30.0), queries).name == "-60"
    assert next_query(inputs(30.0, 0.0, -30.0), queries).name == "60"


def test_two_branches_meet_and_hardly_disagree(whole):
    known, steps = whole
    roots = {view.origin.root for view in known.views if view.origin.kind == GENERATED}
    assert roots == {0, 2}
    errors = [step.loop_error for step in steps if step.loop_error is not None]
    assert errors
    assert max(errors) < 0.02 * 1.2


def test_no_point_is_there_twice(whole):
    """A view from where the map is complete adds next to nothing."""
    known, _ = whole
    again, added = known.added(
        photograph(scenes.orbit_camera(15.0, size=SIZE)),
        torch.ones(SIZE, SIZE),
        known.views[0].origin,
    )
    assert added.fresh.float().mean() < 0.05
    assert len(again) == len(known) + 1


def test_nothing_known_is_changed_by_what_comes_later(whole):
    known, _ = whole
    before = inputs(-30.0, 0.0, 30.0)
    for old, new in zip(before.views, known.views, strict=False):
        assert torch.equal(old.depth, new.depth)
        assert torch.equal(old.confidence, new.confidence)


def test_resumed_from_disk_it_is_the_same_bit_for_bit(whole, tmp_path):
    known, _ = whole
    for index, view in enumerate(known.views[:7]):
        save_view(view, None, tmp_path, index)
    loaded = load_map(tmp_path, known.tolerance)
    resumed, steps = completed(loaded)
    assert len(steps) == len(known) - 7
    for one, other in zip(known.views, resumed.views, strict=True):
        assert one.view.name == other.view.name
        assert torch.equal(one.depth, other.depth)
        assert torch.equal(one.fresh, other.fresh)


def test_a_wrong_picture_is_noticed_and_made_again(whole):
    _, steps = completed(inputs(-30.0, 0.0, 30.0), TracedGenerator(("orbit090",)))
    tried = {step.name: step.attempts for step in steps}
    assert tried.pop("orbit090") == 2
    assert set(tried.values()) == {1}


def test_a_view_of_which_nothing_can_be_tested_shows_nothing_new():
    """It looks away from all that the map shows: no pixel confirms where it stands."""
    known = inputs(-30.0, 0.0, 30.0)
    away = scenes.orbit_camera(0.0, size=SIZE)
    turn = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]))
    camera = replace(away, world_to_cam=turn @ away.world_to_cam)
    picture = View(torch.rand(3, SIZE, SIZE), camera, name="away")
    wall = Wall(2.0)
    assert not prior_of(known, camera, [0, 1, 2]).mask.any()
    proposal = propose(known, picture, [0, 1, 2], wall, ConfidenceConfig())
    assert proposal.edges == 3
    assert proposal.agreement == 0
    assert not proposal.confidence.any()
    off = ConfidenceConfig(reject=False, support=False)
    assert propose(known, picture, [0, 1, 2], wall, off).confidence.any()


def test_a_view_is_as_sure_as_what_bears_it_out():
    """In what it measures beyond the map: less with one edge than with three, and less still if it
    is wrong where the map can tell.
    """
    known = inputs(-30.0, 0.0, 30.0)
    sound = replace(photograph(scenes.orbit_camera(60.0, size=SIZE)), depth=None)
    wrong = replace(sound, image=sound.image.roll(MOVED, -1))
    beyond = ~prior_of(known, sound.camera, [2, 1, 0]).mask

    def surest(picture, source):
        options = ConfidenceConfig(reject=False)
        return float(propose(known, picture, [2, 1, 0], source, options).confidence[beyond].max())

    with_three, with_one = surest(sound, TracedDepth()), surest(sound, OneEdge())
    assert with_three > 0.6
    assert with_one == pytest.approx(with_three * (1 / 2) / (3 / 4), rel=0.05)
    assert surest(wrong, OneEdge()) < 0.7 * with_one


def test_where_both_agree_the_surer_of_map_and_view_counts():
    known = inputs(-30.0, 0.0, 30.0)
    sound = replace(photograph(scenes.orbit_camera(60.0, size=SIZE)), depth=None)
    prior = prior_of(known, sound.camera, [2, 1, 0])
    proposal = propose(known, sound, [2, 1, 0], OneEdge(), ConfidenceConfig())
    as_sure = proposal.confidence >= prior.confidence - 1e-3
    assert as_sure[prior.mask].float().mean() > 0.9


def test_behind_a_surface_that_the_map_shows_as_surely_nothing_enters():
    """Both are sure to 1, but warping has rounded some of the map's confidences below it."""
    known = inputs(-30.0, 0.0, 30.0)
    moved = photograph(scenes.orbit_camera(60.0, size=SIZE))
    moved = replace(moved, image=moved.image.roll(MOVED, -1), depth=None)
    prior = prior_of(known, moved.camera, [2, 1, 0])
    assert ((prior.confidence < 1) & (prior.confidence > 0.999)).any()
    options = ConfidenceConfig(support=False, reject=False)
    proposal = propose(known, moved, [2, 1, 0], OneEdge(), options)
    assert (proposal.view.depth <= 1.02 * prior.depth)[prior.mask].all()


def test_support_is_the_share_confirmed_and_the_share_of_edges():
    depth, sure = torch.full((4, 4), 2.0), torch.full((4, 4), 0.8)
    edges = torch.tensor([1, 2, 3, 3]).expand(4, 4).int()
    measured = Measured(depth, sure, torch.ones(4, 4, dtype=torch.bool), edges, usable_edges=3)
    shown = depth.clone()
    shown[0], shown[1:3] = 0, 2.01  # nothing there, the same surface; then another one
    shown[3] = 2.5
    prior = Prior(torch.zeros(3, 4, 4), shown, (shown > 0).float())
    found = supported(measured, prior, possible_edges=3, tolerance=0.01)
    by_edges = torch.tensor([1 / 2, 2 / 3, 3 / 4, 3 / 4]) / (3 / 4)
    assert torch.allclose(found.confidence, (0.8 * 0.5 * by_edges).expand(4, 4))
    assert found.reliable.all()


def test_confidence_handling_keeps_a_stubbornly_wrong_view_out_of_the_cloud():
    wrong = TracedGenerator(("orbit090", "orbit270"), stubborn=True)
    known = inputs(-30.0, 0.0, 30.0)
    handled, _ = completed(known, wrong)
    off = dict.fromkeys(("repair", "free_space", "support", "votes", "regenerate", "reject"), False)
    trusting, _ = completed(known, wrong, **off)
    assert off_surface(handled) < off_surface(trusting, votes=False) / 2


def test_dataset_depth_needs_a_depth():
    """A picture without depth cannot be paired by a source that reads it from the data."""
    known = inputs(-30.0, 0.0, 30.0)
    options = CompletionConfig()
    queries = orbit_queries(known.cameras, np.radians(30))[:1]
    pipeline = CompletionPipeline(TracedGenerator(), DatasetDepth(), options, 0)
    grown = complete(known, queries, pipeline, lambda m, v, step: None)
    assert (grown.views[-1].confidence <= 1).all()
    assert grown.views[-1].origin.kind == GENERATED
