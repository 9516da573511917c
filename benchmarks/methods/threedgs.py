"""3D Gaussian Splatting (Kerbl et al., 2023), from points that the input views alone give."""

from dataclasses import dataclass

from benchmarks.methods.gaussian_method import GaussianMethod
from extrap_train.gaussians.recipe import Recipe
from extrap_train.gaussians.training_scene import TrainingScene


@dataclass(frozen=True)
class ThreeDgs(GaussianMethod):
    """The published method; it has no schedule for few views, so this is the one for many."""

    def recipe(self, scene: TrainingScene) -> Recipe:
        """The loop's own recipe."""
        return Recipe(self, scene)
