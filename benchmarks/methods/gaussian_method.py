"""A Gaussian method as a row of a table."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.methods.base import SceneInputs, Stopwatch, Synthesis, photographs_used
from extrap_train.depth import DepthSource
from extrap_train.depth.surrogate import AffineSurrogate
from extrap_train.gaussians.fit import Fit, fit
from extrap_train.gaussians.gaussian_options import GaussianOptions
from extrap_train.gaussians.init import Points, parameters_from_points
from extrap_train.gaussians.recipe import Recipe
from extrap_train.gaussians.training_scene import TrainingScene, training_scene

MONOCULAR = ("surrogate", "depth_source")
"""Known values of a method's option `monocular`."""


@dataclass(frozen=True)
class GaussianMethod(GaussianOptions, ABC):
    """Fits Gaussians to the inputs and draws the targets; a subclass names its recipe."""

    @abstractmethod
    def recipe(self, scene: TrainingScene) -> Recipe:
        """What the method does in the training loop."""

    def weight_files(self, category: str) -> Sequence[Path]:
        """None."""
        return ()

    def fit_scene(self, inputs: SceneInputs) -> Fit:
        """The scene that the inputs alone make; the targets are not looked at."""
        return fit(self.recipe(training_scene(inputs.views, inputs.depth_source, inputs.seed)))

    def synthesize(self, inputs: SceneInputs) -> Synthesis:
        """Fit, and draw every target; the time is that of preprocessing and optimisation."""
        self._warm_up(inputs)
        with Stopwatch() as watch:
            trained = self.fit_scene(inputs)
        return Synthesis(
            images=trained.render(inputs.targets),
            seconds=watch.seconds,
            given=trained.record | photographs_used(inputs.views),
            points=trained.seen_surface(),
            counts={"gaussians": float(len(trained.parameters.means))},
        )

    def _warm_up(self, inputs: SceneInputs) -> None:
        """Draw one Gaussian forwards and backwards: the first drawing of a process waits for the
        rasteriser to be compiled and loaded, which would fall to whichever cell comes first.
        """
        point = Points(torch.zeros(1, 3), torch.zeros(1, 3), torch.ones(1))
        parameters = parameters_from_points(point, self.sh_degree, opacity=0.5, widest=0.1)
        learnt = parameters.to(self.device)
        for values in learnt.tensors().values():
            values.requires_grad_()
        scene = training_scene(inputs.views, inputs.depth_source, inputs.seed)
        recipe = Recipe(self, scene)
        recipe.draw(learnt, recipe.camera(0)).image.sum().backward()


def monocular_source(scene: TrainingScene, name: str) -> DepthSource:
    """`surrogate` (the scene's depth source under an unknown affine map) or `depth_source` itself.

    The second is for benchmarks whose depth source is a monocular network. The record says which.
    """
    if name == "depth_source":
        scene.record["monocular"] = "the depth source"
        return scene.depth_source
    scene.record["monocular"] = "surrogate: the depth source under an unknown affine map"
    return AffineSurrogate(scene.depth_source, scene.seed)


def prior_depths(
    scene: TrainingScene, source: DepthSource, device: str
) -> list[Float[Tensor, "h w"]]:
    """Depth of every input view up to an affine map, on `device`; 0 where it is unknown.

    The record says in how many inputs there is any: in others, depth losses are silent.
    """
    priors = [found.reliable() for found in source.depth_maps(scene.given)]
    known = sum(bool((prior > 0).any()) for prior in priors)
    scene.record["monocular depth"] = f"in {known} of {len(priors)} inputs"
    return [prior.to(device) for prior in priors]
