"""The four methods on a ball in a round room: they learn, repeat, leak nothing, and say no."""

import functools
import math
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch

from benchmarks.methods.base import Method, SceneInputs, Synthesis
from benchmarks.methods.dngaussian import DnGaussian
from benchmarks.methods.fsgs import Fsgs
from benchmarks.methods.instantsplat import InstantSplat
from benchmarks.methods.threedgs import ThreeDgs
from extrap_train.depth import DatasetDepth, DepthMap
from extrap_train.errors import InputError
from extrap_train.gaussians.fit import Diverged, Fit, fit, fit_views
from extrap_train.gaussians.gaussian_options import GaussianOptions, exponential
from extrap_train.gaussians.ply import read_splats, write_splats
from extrap_train.gaussians.recipe import Recipe
from extrap_train.gaussians.training_scene import training_scene
from extrap_train.geometry.cameras import unproject_to_world
from extrap_train.metrics import psnr
from tests.benchmarks.analytic import scene_inputs

SMALL = {"iterations": 60, "full_iterations": 240, "init_points": 200, "max_gaussians": 400}
METHODS: dict[str, ThreeDgs] = {
    "3dgs": ThreeDgs(**SMALL),
    "fsgs": Fsgs(**SMALL),
    "dngaussian": DnGaussian(**SMALL | {"full_iterations": 6000}, hash_levels=4, hash_log2_size=10),
    "instantsplat": InstantSplat(**SMALL),
}
each_method = pytest.mark.parametrize("name", METHODS)


@functools.cache
def _synthesized(name: str) -> tuple[Synthesis, Fit]:
    """What a method makes of the scene, and the fit behind it: once for all tests of it."""
    fits: list[Fit] = []
    fitted = ThreeDgs.fit_scene
    with pytest.MonkeyPatch.context() as patch:
        keep = lambda method, inputs: fits.append(fitted(method, inputs)) or fits[-1]  # noqa: E731
        patch.setattr(ThreeDgs, "fit_scene", keep)
        return METHODS[name].synthesize(scene_inputs(size=24)[0]), fits[0]


@functools.cache
def _short_fit(name: str) -> Fit:
    """A few iterations on small inputs, to be compared with other fits of the same length."""
    return replace(METHODS[name], iterations=12).fit_scene(scene_inputs(size=16)[0])


@each_method
def test_it_is_a_method_that_learns_the_scene(name: str) -> None:
    inputs, truth = scene_inputs(size=24)
    method = METHODS[name]
    assert isinstance(method, Method)
    made, _ = _synthesized(name)
    assert made.images.shape == truth.shape
    assert made.images.min() >= 0
    assert made.images.max() <= 1
    assert 0 < made.counts["gaussians"] <= 400
    assert "iterations" in made.given["schedule"]
    assert "init" in made.given
    untrained = replace(method, iterations=1).synthesize(inputs).images
    assert psnr(made.images, truth).mean() > psnr(untrained, truth).mean() + 1


@each_method
def test_targets_change_nothing_that_is_learnt(name: str) -> None:
    """Neither their poses nor their number: the same Gaussians, bit by bit, and the same views."""
    inputs, _ = scene_inputs(size=16)
    other, _ = scene_inputs(targets_deg=(200.0, 10.0, 300.0), size=16)
    first, second = _short_fit(name), replace(METHODS[name], iterations=12).fit_scene(other)
    for key, value in first.parameters.tensors().items():
        assert value.equal(second.parameters.tensors()[key]), key
    assert first.record == second.record
    alone, among = first.render(inputs.targets)[0], second.render(other.targets)[1]
    torch.testing.assert_close(alone, among, atol=1e-5, rtol=0)  # batches round otherwise


@each_method
def test_an_input_changes_what_is_learnt(name: str) -> None:
    """The counterpart: the test above would see a leak, for it sees a change of the inputs."""
    inputs, _ = scene_inputs(size=16)
    brighter = replace(inputs.views[0], image=(inputs.views[0].image + 0.1).clamp(0, 1))
    changed = replace(inputs, views=(brighter, *inputs.views[1:]))
    first = _short_fit(name).parameters
    second = replace(METHODS[name], iterations=12).fit_scene(changed).parameters
    assert len(first) != len(second) or not first.means.equal(second.means)


def _one_view(inputs: SceneInputs) -> SceneInputs:
    return replace(inputs, views=inputs.views[:1])


def _nan_in_a_pose(inputs: SceneInputs) -> SceneInputs:
    view = inputs.views[1]
    world_to_cam = view.camera.world_to_cam.clone()
    world_to_cam[0, 3] = math.nan
    broken = replace(view, camera=replace(view.camera, world_to_cam=world_to_cam), name="b.png")
    return replace(inputs, views=(inputs.views[0], broken))


def _spoilt(inputs: SceneInputs, **changes) -> SceneInputs:
    view = replace(inputs.views[1], name="b.png", **changes)
    return replace(inputs, views=(inputs.views[0], view))


def _cut(inputs: SceneInputs) -> SceneInputs:
    view = inputs.views[1]
    return _spoilt(inputs, image=view.image[:, :, :12], depth=view.depth[:, :12])


def _bytes(inputs: SceneInputs) -> SceneInputs:
    return _spoilt(inputs, image=255 * inputs.views[1].image)


def _no_focal(inputs: SceneInputs) -> SceneInputs:
    camera = inputs.views[1].camera
    intrinsics = camera.intrinsics * (1 - torch.eye(3)) + torch.diag(torch.tensor([0.0, 9, 1]))
    return _spoilt(inputs, camera=replace(camera, intrinsics=intrinsics))


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (_cut, "b.png: its image is 12x16, its camera's 16x16"),
        (_bytes, "b.png: its colours run from .* and not from 0 to 1"),
        (_no_focal, "b.png: its focal length is not positive"),
    ],
)
def test_a_view_that_does_not_fit_its_camera_is_named(spoil, said: str) -> None:
    inputs = spoil(scene_inputs(size=16)[0])
    with pytest.raises(InputError, match=said):
        training_scene(inputs.views, inputs.depth_source, seed=0)


@each_method
@pytest.mark.parametrize(
    ("spoil", "said"), [(_one_view, "at least two"), (_nan_in_a_pose, "b.png: .* not finite")]
)
def test_views_that_cannot_be_used_are_named(name: str, spoil, said: str) -> None:
    inputs, _ = scene_inputs(size=16)
    with pytest.raises(InputError, match=said):
        METHODS[name].synthesize(spoil(inputs))


@dataclass(frozen=True)
class _FlatDepth(DatasetDepth):
    """A depth source that answers with one value everywhere."""

    value: float

    def depth_maps(self, views) -> list[DepthMap]:
        flat = [torch.full_like(view.image[0], self.value) for view in views]
        return [DepthMap(depth, torch.ones_like(depth)) for depth in flat]


@pytest.mark.parametrize(
    ("value", "said"), [(0.0, "no initial points"), (math.inf, "initial point is not finite")]
)
@pytest.mark.parametrize("method", [InstantSplat(**SMALL), ThreeDgs(**SMALL, init="dense")])
def test_depth_without_points_or_with_infinite_ones_is_refused(method, value, said) -> None:
    inputs, _ = scene_inputs(size=16)
    with pytest.raises(InputError, match=said):
        method.synthesize(replace(inputs, depth_source=_FlatDepth(value)))


def test_no_triangulated_point_and_no_random_one_is_refused() -> None:
    inputs, _ = scene_inputs(inputs_deg=(0.0, 170.0), size=16)
    with pytest.raises(InputError, match=r"no initial points.*init=random"):
        ThreeDgs(init_points=0).synthesize(inputs)


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("init", "mvs"),
        ("iterations", 0),
        ("iterations", -5),
        ("max_gaussians", 0),
        ("sh_degree", 4),
        ("sh_degree", -1),
        ("sh_every", 0),
        ("init_opacity", 1.0),
        ("init_opacity", math.nan),
        ("means_rate", math.nan),
        ("prune_opacity", 1.5),
        ("reset_every", -1),
        ("background", "grey"),
        ("rasterizer", "taichi"),
        ("monocular", "dpt"),
        ("clear_every", -25),
        ("hash_levels", 1),
        ("hash_log2_size", -1),
    ],
)
def test_an_option_that_cannot_be_meant_is_named(option: str, value) -> None:
    with pytest.raises(InputError, match=option):
        DnGaussian(**SMALL | {option: value})


@pytest.mark.parametrize(
    ("option", "value"),
    [("pseudo_every", 0), ("monocular", "dpt"), ("init", "mvs")],
)
def test_an_option_of_fsgs_that_cannot_be_meant_is_named(option: str, value) -> None:
    with pytest.raises(InputError, match=option):
        Fsgs(**SMALL | {option: value})


def test_an_optimisation_that_diverges_is_stopped_with_its_iteration() -> None:
    inputs, _ = scene_inputs(size=16)
    wild = ThreeDgs(**SMALL, log_scales_rate=1e5, means_rate=1e30, means_rate_final=1e30)
    with pytest.raises(Diverged, match=r"in iteration .* of 60; lower the learning rates"):
        wild.synthesize(inputs)


@pytest.mark.parametrize("rate", ["opacity_logits_rate", "log_scales_rate", "quats_rate"])
def test_no_parameter_diverges_unseen(rate: str) -> None:
    """A Gaussian that is NaN is not drawn, so that the loss stays finite."""
    inputs, _ = scene_inputs(size=16)
    with pytest.raises(Diverged, match=r"in iteration .* of 60; lower the learning rates"):
        ThreeDgs(**SMALL | {rate: 1e38}).synthesize(inputs)


def test_growth_stops_at_the_limit_and_says_so() -> None:
    inputs, _ = scene_inputs(size=24)
    eager = replace(ThreeDgs(**SMALL), densify_from=0, max_gaussians=210, densify_gradient=0.0)
    made = eager.synthesize(inputs)
    assert made.counts["gaussians"] <= 210
    assert made.given["growth"] == "stopped at 210 Gaussians"


def test_growth_adds_gaussians_where_it_may() -> None:
    inputs, _ = scene_inputs(size=24)
    eager = replace(ThreeDgs(**SMALL), densify_from=0, max_gaussians=2000, densify_gradient=1e-6)
    assert eager.synthesize(inputs).counts["gaussians"] > 250


@pytest.mark.parametrize("name", ["fsgs", "dngaussian"])
def test_the_record_says_in_how_many_inputs_there_was_depth(name: str) -> None:
    inputs, _ = scene_inputs(size=16)
    blind = replace(inputs.views[0], depth=torch.zeros(16, 16))
    some = replace(inputs, views=(blind, *inputs.views[1:]))
    method = replace(METHODS[name], iterations=1)
    assert method.fit_scene(some).record["monocular depth"] == "in 2 of 3 inputs"


def test_a_networks_colours_are_baked_for_whoever_takes_the_gaussians_away() -> None:
    """As the inputs see them on the mean: untrained harmonics would be noise."""
    _, fitted = _synthesized("dngaussian")
    cameras = [view.camera for view in fitted.recipe.scene.views]
    seen = [fitted.recipe.colors(fitted.parameters, camera) for camera in cameras]
    taken = fitted.gaussians().sh
    expected = sum(each.detach() for each in seen) / len(seen)
    torch.testing.assert_close(0.5 + taken[:, 0] / (2 * math.sqrt(math.pi)), expected)
    assert not taken[:, 1:].any()


def test_dngaussian_takes_soft_steps_from_a_sixth_of_the_training_on() -> None:
    assert _short_fit("dngaussian").record["soft depth"] == "in 10 iterations"


def test_instantsplat_stops_where_a_published_schedule_stands_after_its_iterations() -> None:
    published = exponential(1.6e-4, 1.6e-6, progress=1000 / 30_000)
    assert InstantSplat().means_rate_final == pytest.approx(published, rel=1e-3)


def test_given_points_are_where_training_starts() -> None:
    inputs, _ = scene_inputs(size=16)
    options = GaussianOptions(iterations=1, sh_degree=0)
    recipe = Recipe(options, training_scene(inputs.views, inputs.depth_source, 0))
    points = recipe.initial_points()
    started = fit(Recipe(options, recipe.scene), points[torch.arange(50)])
    assert (started.parameters.means - points.positions[:50]).abs().max() < 0.01
    assert started.gaussians().means.shape == (50, 3)


def test_the_world_comes_back_in_the_units_it_was_given_in() -> None:
    """The dense start lies where the inputs' depth does, in their world."""
    inputs, _ = scene_inputs(size=16)
    method = InstantSplat(iterations=1, confidence_rates=False)
    start = replace(method, full_iterations=1).fit_scene(inputs).gaussians()
    surface = [unproject_to_world(view.depth, view.camera).flatten(0, 1) for view in inputs.views]
    exact = "donot_use_mm_for_euclid_dist"
    distance = torch.cdist(start.means, torch.cat(surface), compute_mode=exact).amin(1)
    assert (distance < 2e-3).all()
    assert len(start) > 256


def test_a_capture_with_depth_becomes_gaussians_that_a_ply_holds(tmp_path) -> None:
    inputs, truth = scene_inputs(size=24)
    options = GaussianOptions(iterations=40, full_iterations=40, init="dense", sh_degree=1)
    fitted = fit_views(inputs.views, inputs.depth_source, options, seed=0)
    assert psnr(fitted.render(inputs.targets), truth).mean() > 14
    write_splats(tmp_path / "splats.ply", fitted.gaussians())
    torch.testing.assert_close(
        read_splats(tmp_path / "splats.ply").means, fitted.gaussians().means, atol=1e-5, rtol=1e-5
    )


@pytest.mark.slow
def test_the_pages_example_runs_as_it_stands(tmp_path, monkeypatch) -> None:
    page = (Path(__file__).parents[2] / "docs" / "gaussians.md").read_text(encoding="utf-8")
    example = page.split("```python\n")[1].split("```")[0]
    monkeypatch.chdir(tmp_path)
    exec(compile(example, "docs/gaussians.md", "exec"), {})
    assert len(read_splats(tmp_path / "hydrant.ply")) > 100
