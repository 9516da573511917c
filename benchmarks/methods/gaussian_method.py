"""A Gaussian method as a row of a table."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.methods.base import SceneInputs, Stopwatch, Synthesis, photographs_used
from extrap_train.config.options import option
from extrap_train.depth import DepthSource
from extrap_train.depth.surrogate import AffineSurrogate
from extrap_train.gaussians.fit import Fit, fit
from extrap_train.gaussians.gaussian_options import GaussianOptions
from extrap_train.gaussians.init import Points, parameters_from_points
from extrap_train.gaussians.recipe import Recipe
from extrap_train.gaussians.training_scene import TrainingScene, training_scene


@dataclass(frozen=True)
class GaussianMethod(GaussianOptions):
    """Fits Gaussians to the inputs and draws the targets; a subclass may have its own recipe."""

    recipe: ClassVar[type[Recipe]] = Recipe
    """What the method does in the training loop."""

    def weight_files(self, category: str) -> Sequence[Path]:
        """No files: nothing is pre-trained."""
        return ()

    def fit_scene(self, inputs: SceneInputs) -> Fit:
        """The scene that the inputs alone make; the targets are not looked at."""
        scene = training_scene(inputs.views, inputs.depth_source, inputs.seed)
        return fit(self.recipe(self, scene))

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


@dataclass(frozen=True)
class MonocularMethod(GaussianMethod):
    """One that is also told a monocular network's depth, or what stands for it."""

    monocular: str = option(
        "surrogate",
        "monocular depth: the depth source under an unknown affine map, or as it is",
        known=("surrogate", "depth_source"),
    )

    def priors(self, scene: TrainingScene) -> tuple[DepthSource, list[Float[Tensor, "h w"]]]:
        """The source, and by it the depth of every input up to an affine map; 0 where unknown.

        The record says which source, and in how many inputs there is any depth: in others, depth
        losses are silent.
        """
        source: DepthSource = scene.depth_source
        scene.record["monocular"] = "the depth source"
        if self.monocular == "surrogate":
            source = AffineSurrogate(source, scene.seed)
            scene.record["monocular"] = "surrogate: the depth source under an unknown affine map"
        found = [depth.reliable() for depth in source.depth_maps(scene.given)]
        known = sum(bool((depth > 0).any()) for depth in found)
        scene.record["monocular depth"] = f"in {known} of {len(found)} inputs"
        return source, [depth.to(self.device) for depth in found]
