"""InstantSplat (Fan et al., 2024): a dense start from depth, poses refined with the scene."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from benchmarks.methods.gaussian_method import GaussianMethod
from extrap_train.gaussians.covisibility import unique_pixels
from extrap_train.gaussians.points import Points, joined, pixel_points
from extrap_train.gaussians.poses import PoseCorrections, similarity_between
from extrap_train.gaussians.recipe import Recipe
from extrap_train.gaussians.scene import TrainingScene
from extrap_train.views import Camera

_STEADY, _LOOSE = 1.0, 100.0
"""Step of a mean at full confidence, and at none."""


@dataclass(frozen=True)
class InstantSplat(GaussianMethod):
    """A point a pixel, no growth, quick learning rates, joint pose refinement."""

    full_iterations: int = 1000
    init: str = "dense"
    init_points: int = 100_000
    max_gaussians: int = 100_000
    sh_degree: int = 0
    means_rate_final: float = 1.372e-4
    """1.6e-4 → 1.6e-6 over 30,000 iterations, of which 1000 are run: 1.6e-4 · 0.01^(1 / 30)."""
    sh_dc_rate: float = 0.025
    log_scales_rate: float = 0.05
    quats_rate: float = 0.01
    densify_until: int = 0
    reset_every: int = 0

    covisibility: float = 0.01
    """Depths nearer than this share of the view's range are the same surface; 0: keep all."""
    confidence_rates: bool = True
    """Whether unsure points move faster."""
    pose_rate: float = 1e-4
    """Of the input poses' corrections, to `pose_rate_final`; 0: the poses stay as given."""
    pose_rate_final: float = 1e-6

    def recipe(self, scene: TrainingScene) -> Recipe:
        """3DGS's loop without its growth."""
        return InstantSplatRecipe(self, scene)


class InstantSplatRecipe(Recipe):
    """Dense points less those seen twice; their confidence and the poses take part."""

    options: InstantSplat

    def __init__(self, options: InstantSplat, scene: TrainingScene) -> None:
        super().__init__(options, scene)
        self._poses = PoseCorrections(len(scene.views)).to(options.device)

    def initial_points(self) -> Points:
        """Every reliable pixel that no better view shows already."""
        views, options = self.scene.views, self.options
        maps = self.scene.depth_maps(self.scene.depth_source)
        wanted = unique_pixels(views, maps, options.covisibility)
        found = joined([pixel_points(*each) for each in zip(views, maps, wanted, strict=True)])
        points = found.at_most(
            min(options.init_points, options.max_gaussians), self.generator
        )  # fmt: skip
        if options.confidence_rates:
            self.means_factor = confidence_factor(points.confidence)[:, None].to(options.device)
        self.scene.record["init"] = f"{len(points)} points of the depth source, seen once"
        refined = "refined with the scene" if options.pose_rate > 0 else "as given"
        self.scene.record["poses"] = f"{refined}; targets moved along, no photograph of them used"
        return points

    def modules(self) -> Sequence[tuple[nn.Module, float, float]]:
        """The poses' corrections."""
        if self.options.pose_rate == 0:
            return ()
        return ((self._poses, self.options.pose_rate, self.options.pose_rate_final),)

    def camera(self, index: int) -> Camera:
        """The input's camera as it is refined so far."""
        return self._poses.corrected(super().camera(index), index)

    @torch.no_grad()
    def target_cameras(self, cameras: Camera) -> Camera:
        """Moved as the input cameras have moved on the whole."""
        refined = [self.camera(index) for index in range(len(self.cameras))]
        return similarity_between(self.cameras, refined).camera(cameras)


def confidence_factor(confidence: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """Step of each mean: 1 + 99 · (1 − sigmoid(c)), c the confidence on DUSt3R's scale.

    DUSt3R's confidences start at 1 and have no end; ours lie in [0, 1], and 1 / (1 − ours) is of
    that kind.
    """
    dust3r = 1 / (1 - confidence.clamp(0, 0.999))
    return _STEADY + (_LOOSE - _STEADY) * (1 - torch.sigmoid(dust3r))
