"""FSGS's pseudo views, with a stand-in for a network: recorded depth cannot look at a drawing."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
import torch

from benchmarks.methods.fsgs import Fsgs, FsgsRecipe
from extrap_train.depth import DatasetDepth, DepthMap
from extrap_train.errors import InputError
from extrap_train.gaussians.density import GrowthStatistics
from extrap_train.gaussians.gaussian_options import Schedule
from extrap_train.gaussians.init import parameters_from_points
from extrap_train.gaussians.optimiser import GaussianOptimiser
from extrap_train.gaussians.recipe import Training
from extrap_train.gaussians.training_scene import training_scene
from extrap_train.views import View
from tests.benchmarks.analytic import scene_inputs

OPTIONS = Fsgs(iterations=40, init="random", init_points=80, monocular="depth_source")
RATES = dict.fromkeys(("means", "log_scales", "quats", "opacity_logits", "sh_dc", "sh_rest"), 0.0)
RAMP = torch.linspace(1, 2, 16).expand(16, 16).contiguous()


@dataclass(frozen=True)
class _Network(DatasetDepth):
    """Sees a ramp in every photograph, and remembers the drawings that it was shown."""

    blind: bool = False
    drawings: list[View] = field(default_factory=list)

    @property
    def image_size(self) -> int:  # type: ignore[override]
        return 16

    def depth_map(self, view: View, neighbours: Sequence[View]) -> DepthMap:
        if view.depth is None:
            if self.blind:
                raise InputError("nothing to go by")
            self.drawings.append(view)
        return DepthMap(RAMP, torch.ones_like(RAMP))


def _under_way(network: _Network) -> tuple[FsgsRecipe, Training]:
    inputs, _ = scene_inputs(size=16)
    recipe = OPTIONS.recipe(OPTIONS, training_scene(inputs.views, network, seed=0))
    assert isinstance(recipe, FsgsRecipe)
    start = parameters_from_points(recipe.initial_points(), 0, 0.5, widest=0.1)
    return recipe, Training(
        GaussianOptimiser(start, RATES),
        GrowthStatistics.empty(start.means),
        Schedule(OPTIONS.iterations, OPTIONS.full_iterations),
        recipe.generator,
        iteration=20,
    )


def test_the_loss_is_what_the_drawings_depth_lacks_in_correlation() -> None:
    """With the better reading of the network's answer, and with a gradient to the Gaussians."""
    network = _Network()
    recipe, training = _under_way(network)
    loss = recipe._pseudo_loss(training)
    (shown,) = network.drawings
    assert not any(torch.equal(shown.camera.world_to_cam, v.camera.world_to_cam)
                   for v in recipe.scene.views)  # fmt: skip
    drawn = recipe.draw(training.optimiser.parameters, shown.camera, progress=0.5).depth
    depth = drawn.detach().double().numpy().ravel()
    readings = [RAMP.double().numpy().ravel(), -1 / RAMP.double().numpy().ravel()]
    expected = min(1 - np.corrcoef(depth, reading)[0, 1] for reading in readings)
    assert float(loss.detach()) == pytest.approx(expected, abs=1e-4)
    loss.backward()
    assert training.optimiser.parameters.means.grad.abs().max() > 0


def test_a_network_that_finds_nothing_in_a_drawing_costs_nothing_and_is_told() -> None:
    recipe, training = _under_way(_Network(blind=True))
    assert float(recipe._pseudo_loss(training).detach()) == 0
    assert recipe.scene.record["pseudo views"] == "some had no depth: nothing to go by"


def test_they_are_drawn_in_their_part_of_the_training() -> None:
    """Published: from 2000 to 9500 of 10,000; here every second iteration of 9 to 38 of 40."""
    inputs, _ = scene_inputs(size=16)
    network = _Network()
    method = replace(OPTIONS, pseudo_every=2)
    record = method.fit_scene(replace(inputs, depth_source=network)).record
    assert record["pseudo views"] == "yes"
    assert len(network.drawings) == 15
