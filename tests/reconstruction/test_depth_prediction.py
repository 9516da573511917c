"""The depth of a generated view, on a sphere over a plane: its back is known in closed form."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import scenes
import torch
from in_process import run_command

from extrap_train.__main__ import main
from extrap_train.config import CompletionConfig, TrainerConfig
from extrap_train.data.sequences import Frame
from extrap_train.depth import DatasetDepth
from extrap_train.errors import InputError
from extrap_train.geometry.visibility import Ball
from extrap_train.reconstruction.completion import CompletionPipeline, add_view, map_of_inputs
from extrap_train.reconstruction.depth_prediction.depth_examples import (
    MIN_FRAMES,
    DepthExamples,
    draw_examples,
    with_truth,
)
from extrap_train.reconstruction.depth_prediction.inference import (
    NetworkDepth,
    PredictedDepth,
    fit_to_known,
)
from extrap_train.reconstruction.depth_prediction.network import (
    CONFIDENT_WITHIN,
    DepthMixture,
    DepthNetwork,
    load_depth_network,
    save_depth_network,
)
from extrap_train.reconstruction.depth_prediction.network_training import (
    DepthTraining,
    StoredExamples,
    calibrate,
    loss_of,
    save_examples,
)
from extrap_train.reconstruction.depth_prediction.observation import (
    CERTAIN,
    CHANNELS,
    ENTRY,
    MEASURED,
    observe,
)
from extrap_train.reconstruction.global_map import prior_of
from extrap_train.reconstruction.planner import Query
from extrap_train.views import Camera, View, stack_cameras

SIZE = 64
TINY = (16, 16, 16)
BALL = scenes.Scene((scenes.sphere(0.6), scenes.plane(0.6, (0.0, 1.0, 0.0))))
PLANE = scenes.Scene((scenes.plane(0.6, (0.0, 1.0, 0.0)),))


def photograph(azimuth_deg: float, scale: float = 1.0) -> View:
    camera = scenes.orbit_camera(azimuth_deg, size=SIZE)
    depth = BALL.depth(camera)
    mask = (depth != PLANE.depth(camera)).float()
    moved = camera.world_to_cam.clone()
    moved[:3, 3] *= scale
    return View(
        BALL.image(camera),
        replace(camera, world_to_cam=moved),
        scale * depth,
        mask,
        f"{azimuth_deg}",
    )


def observed(query: View, references: list[View]):
    cameras = stack_cameras([view.camera for view in references])
    depths = torch.stack([view.depth for view in references])[None]
    return observe(
        query.image[None],
        stack_cameras([query.camera]),
        torch.stack([view.image for view in references])[None],
        depths,
        (depths > 0).float(),
        stack_cameras([cameras]),
        Ball.around(cameras),
        *torch.zeros(2, 1, SIZE, SIZE),
    )


def front(scale: float = 1.0) -> list[View]:
    return [photograph(azimuth, scale) for azimuth in (-25.0, 0.0, 25.0)]


def test_what_is_certain_is_right_and_no_surface_lies_in_front_of_unobserved_space():
    for azimuth in (40.0, 90.0, 180.0):
        query = photograph(azimuth)
        seen = observed(query, front())
        certain = seen.features[0, CERTAIN] > 0
        prior = seen.depth(seen.features[:, MEASURED])[0]
        off = (prior / query.depth - 1).abs()[certain]
        assert (off < 0.03).float().mean() > 0.97
        on_ball = (query.mask > 0.5) & ~certain
        assert on_ball.sum() > 20
        entry = seen.depth(seen.features[:, ENTRY])[0]
        assert (entry < query.depth * 1.03)[on_ball].float().mean() > 0.97


def test_the_observation_has_no_unit():
    one = observed(photograph(120.0), front()).features
    other = observed(photograph(120.0, 7.0), front(7.0)).features
    assert (one - other).abs().gt(1e-3).float().mean() < 0.01


def mixture() -> DepthMixture:
    generator = torch.Generator().manual_seed(0)
    modes, spreads, shares = torch.rand(3, 2, 2, 2, 2, generator=generator)
    return DepthMixture(modes, 0.01 + 0.05 * spreads, shares.log_softmax(1))


def test_the_mixture_is_a_density_and_its_confidence_the_mass_around_the_mode():
    found = mixture()
    grid = torch.linspace(-1, 2, 3001)
    step = float(grid[1] - grid[0])
    density = torch.stack([(-found.negative_log_likelihood(x.expand(2, 2, 2))).exp() for x in grid])
    assert torch.allclose(density.sum(0) * step, torch.ones(2, 2, 2), atol=1e-3)
    mode, confidence = found.best()
    near = (grid[:, None, None, None] - mode).abs() <= CONFIDENT_WITHIN
    assert torch.allclose((density * near).sum(0) * step, confidence, atol=0.05)
    assert (mode[:, None] == found.modes).any(1).all()


def test_calibration_finds_the_spread_of_the_errors():
    """An untrained network answers with the prior; errors are drawn around it."""
    torch.manual_seed(0)
    network = DepthNetwork(TINY).requires_grad_(False)
    examples = torch.zeros(4, CHANNELS + 2, SIZE, SIZE)
    examples[:, CHANNELS + 1] = 5
    spread = float(network(examples[:, :CHANNELS]).spreads.mean())
    rng = np.random.default_rng(0)
    for factor in (0.5, 2.0):
        drawn = rng.laplace(scale=factor * spread, size=(4, SIZE, SIZE))
        examples[:, CHANNELS] = torch.from_numpy(drawn).float()
        scores = calibrate(network, [examples])
        assert float(network.spread_factor) == pytest.approx(factor, rel=0.2)
        assert scores.calibration_error < 0.02


def test_depth_meets_what_is_known_at_the_rim():
    """Two surfaces, the farther one off by 5 %: it is moved as a whole, the other one stays."""
    truth = torch.zeros(32, 32)
    truth[:, 16:] = 0.5
    found = truth.clone()
    found[:, 16:] += 0.05
    certain = torch.zeros(32, 32, dtype=torch.bool)
    certain[:4] = True
    fitted = fit_to_known(found, truth, certain)
    assert torch.equal(fitted[certain], truth[certain])
    assert (fitted - truth)[4:8].abs().max() < 0.02
    assert (fitted - truth)[:, :16].abs().max() < 1e-3
    unrelated = fit_to_known(found + 1, truth, certain)
    assert torch.equal(unrelated[8:], found[8:] + 1)


def ball_frame(azimuth_deg: float) -> Frame:
    view = photograph(azimuth_deg)

    def load(*, depth: bool = True) -> View:
        return view

    return Frame(view.name, view.camera, True, True, load, ())


def truth(camera: Camera) -> tuple[torch.Tensor, torch.Tensor]:
    depth = BALL.depth(camera)
    return depth, (depth != PLANE.depth(camera)).float()


@pytest.fixture(scope="module")
def drawn() -> DepthExamples:
    frames = [ball_frame(azimuth) for azimuth in range(0, 360, 15)]
    rng = np.random.default_rng(0)
    return draw_examples(frames, truth, ExactGenerator(), DatasetDepth(), rng)


@pytest.fixture(scope="module")
def stored(drawn, tmp_path_factory) -> StoredExamples:
    path = tmp_path_factory.mktemp("examples") / "ball.npy"
    save_examples(drawn, path)
    return StoredExamples([path])


def test_a_tiny_network_learns_the_back_of_the_ball(stored, tmp_path):
    """Measured from an angle that is not among the examples, most of it where no input looks."""
    options = TrainerConfig(batch_size=4, warmup_steps=5, ema_decay=0.8, lr_decay_start=1000)
    training = DepthTraining(options, 0, TINY)
    for _ in range(20):
        training.advance(stored)
    query = photograph(165.0)
    save_examples(
        with_truth(observed(query, front()), query.depth, query.mask), tmp_path / "back.npy"
    )
    (back,) = StoredExamples([tmp_path / "back.npy"]).captures()
    with torch.inference_mode():
        learnt, untrained = (
            float(loss_of(network, back))
            for network in (training.averaged_network(), DepthNetwork(TINY))
        )
    assert learnt < untrained - 1


def test_a_resumed_training_takes_the_same_steps(stored, tmp_path):
    options = TrainerConfig(batch_size=1)
    whole, first, resumed = (DepthTraining(options, 0, TINY) for _ in range(3))
    for _ in range(3):
        whole.advance(stored)
    first.advance(stored)
    first.save(tmp_path / "checkpoint.pt")
    resumed.load(tmp_path / "checkpoint.pt")
    for _ in range(2):
        resumed.advance(stored)
    assert resumed.step == whole.step
    for one, other in zip(whole.network.parameters(), resumed.network.parameters(), strict=True):
        assert torch.equal(one, other)


def test_weights_come_back_and_others_are_refused(tmp_path):
    network = DepthNetwork()
    path = tmp_path / "depth.safetensors"
    save_depth_network(network, path)
    assert path.stat().st_size < 3e6
    features = torch.randn(1, CHANNELS, SIZE, SIZE)
    found = load_depth_network(path)(features)
    assert torch.allclose(found.modes, network(features).modes, atol=1e-2)
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(InputError, match="task=depth"):
        load_depth_network(path)
    save_depth_network(DepthNetwork(TINY), path)
    with pytest.raises(InputError, match="task=depth"):
        load_depth_network(path)
    (tmp_path / "checkpoint.pt").write_bytes(b"no checkpoint")
    with pytest.raises(InputError, match=r"checkpoint\.pt"):
        DepthTraining(TrainerConfig(), 0, TINY).load(tmp_path / "checkpoint.pt")


@dataclass(frozen=True)
class ExactGenerator:
    """True pictures."""

    image_size = warp_size = SIZE

    def generate(self, references, queries, names, seed=0):
        @dataclass(frozen=True)
        class Made:
            images: torch.Tensor

        return Made(torch.stack([BALL.image(queries[i]) for i in range(len(names))]))


def exact(known, picture, indices) -> PredictedDepth:
    depth = BALL.depth(picture.camera)
    shown = prior_of(known, picture.camera, indices).depth
    return PredictedDepth(depth, (depth > 0).float(), (shown / depth - 1).abs() < 0.02)


def test_a_view_enters_with_the_completed_depth_where_the_map_is_not_certain():
    views = [replace(view, mask=None) for view in front()]
    known = map_of_inputs(views, [(view.depth > 0).float() for view in views], 0.01)
    camera: Camera = scenes.orbit_camera(60.0, size=SIZE)
    pipeline = CompletionPipeline(ExactGenerator(), DatasetDepth(), CompletionConfig(), 0, exact)
    _, added, step = add_view(known, Query("q", camera), pipeline)
    truth = BALL.depth(camera)
    assert step.agreement > 0.9
    assert (added.confidence > 0.5)[truth > 0].float().mean() > 0.9
    assert ((added.depth / truth - 1).abs()[truth > 0] < 0.02).float().mean() > 0.9
    shown = prior_of(known, camera, [2, 1, 0]).mask
    assert added.confidence[~shown].max() < 0.75


def test_the_network_keeps_what_the_map_is_certain_of():
    views = [replace(view, mask=None) for view in front()]
    known = map_of_inputs(views, [(view.depth > 0).float() for view in views], 0.01)
    picture = replace(photograph(40.0), depth=None, mask=None)
    found = NetworkDepth(DepthNetwork().eval(), DatasetDepth())(known, picture, [0, 1, 2])
    off = (found.depth / BALL.depth(picture.camera) - 1).abs()
    assert found.certain.float().mean() > 0.3
    assert (off[found.certain] < 0.03).float().mean() > 0.95
    assert ((found.confidence >= 0) & (found.confidence <= 1)).all()


def test_with_truth_weighs_nothing_where_the_truth_is_unknown():
    query = photograph(90.0)
    holed = torch.where(query.mask > 0.5, 0, query.depth)
    weight = with_truth(observed(query, front()), holed, query.mask).weight[0]
    assert (weight[query.mask > 0.5] == 0).all()
    assert (weight[holed > 0] > 0).all()


def test_examples_are_what_completion_observes_with_the_true_depth(drawn):
    """Twice for every generated view; where the map is certain, it shows the truth."""
    assert len(drawn.log_depth) % 2 == 0
    certain = drawn.seen.certain & (drawn.weight > 0)
    off = (drawn.seen.warp_log_depth - drawn.log_depth).abs()
    assert certain.float().mean() > 0.1
    assert (off[certain] < 0.05).float().mean() > 0.9


def test_captures_of_too_few_photographs_are_refused(tmp_path):
    few = f"data.frames={MIN_FRAMES - 1}"
    said = run_command(main, "task=depth", "category=cup", few, f"output={tmp_path}", status=1)
    assert said.startswith(f"error: {few}")
    assert not [*tmp_path.iterdir()]
