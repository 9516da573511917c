"""A Gaussian method as a row of a table."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.methods.base import SceneInputs, Stopwatch, Synthesis
from benchmarks.methods.gaussians.options import GaussianOptions
from benchmarks.methods.gaussians.recipe import Recipe
from benchmarks.methods.gaussians.scene import TrainingScene, training_scene
from benchmarks.methods.gaussians.trainer import Fit, fit


@dataclass(frozen=True)
class GaussianMethod(GaussianOptions, ABC):
    """Fits Gaussians to the inputs and draws the targets; a subclass names its recipe."""

    @abstractmethod
    def recipe(self, scene: TrainingScene) -> Recipe:
        """What the method does in the training loop."""

    def weight_files(self, category: str) -> Sequence[Path]:
        """None."""
        return ()

    def fitted(self, inputs: SceneInputs) -> Fit:
        """The scene that the inputs alone make; the targets are not looked at."""
        return fit(self.recipe(training_scene(inputs.views, inputs.depth_source, inputs.seed)))

    def synthesize(self, inputs: SceneInputs) -> Synthesis:
        """Fit, and draw every target; the time is that of preprocessing and optimisation."""
        with Stopwatch() as watch:
            trained = self.fitted(inputs)
        return Synthesis(
            images=trained.render(inputs.targets),
            seconds=watch.seconds,
            given=trained.record,
            points=trained.seen_surface(),
            counts={"gaussians": float(len(trained.parameters.means))},
        )
