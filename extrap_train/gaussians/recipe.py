"""What one method does in the training loop; this one is 3DGS, and others override parts of it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor, nn

from extrap_train.gaussians.density import GrowthStatistics, grow, prune, reset_opacity
from extrap_train.gaussians.gaussian_model import GaussianParameters, rgb_to_sh
from extrap_train.gaussians.gaussian_options import (
    BACKGROUNDS,
    MIN_BETWEEN_GROWTH,
    MIN_BETWEEN_RESETS,
    GaussianOptions,
    Schedule,
)
from extrap_train.gaussians.init import (
    Points,
    pixel_points,
    random_points,
    triangulate_points,
)
from extrap_train.gaussians.losses import photometric_loss, prepare_truth
from extrap_train.gaussians.optimiser import GaussianOptimiser
from extrap_train.gaussians.rasterize import Drawing, draw, rasterizer
from extrap_train.gaussians.training_scene import TrainingScene
from extrap_train.views import Camera, combine


@dataclass
class Training:
    """A training under way."""

    optimiser: GaussianOptimiser
    statistics: GrowthStatistics
    schedule: Schedule
    generator: torch.Generator
    iteration: int = 0


@dataclass(frozen=True)
class Objective:
    """A loss to step along, and the drawing whose screen-space gradient tells where to grow."""

    loss: Float[Tensor, ""]
    drawing: Drawing | None = None


OptimiserStep = Callable[[Training, int], Objective]
"""Takes the training and the index of the input view whose turn it is."""


class Recipe:
    """3DGS (Kerbl et al., 2023)."""

    means_factor: Float[Tensor, "n 1"] | None = None
    """Multiplies each Gaussian's step of its mean; only for methods that do not grow."""

    def __init__(self, options: GaussianOptions, scene: TrainingScene) -> None:
        self.options, self.scene = options, scene
        self.generator = torch.Generator().manual_seed(scene.seed)
        self.background = BACKGROUNDS[options.background]
        self._rasterize = rasterizer(options.rasterizer)
        self.cameras = [view.camera.to(options.device) for view in scene.views]
        """The inputs' cameras on the device of the fit; `scene` stays on the CPU."""
        self._photographs = [prepare_truth(view.image.to(options.device)) for view in scene.views]

    def initial_points(self) -> Points:
        """The points that training starts from, on the CPU; the record says which."""
        options, views = self.options, self.scene.views
        cameras = [view.camera for view in views]
        match options.init:
            case "random":
                points = random_points(cameras, options.init_points, self.generator)
                self.scene.record["init"] = f"{len(points)} random points"
            case "dense":
                maps = self.scene.depth_maps(self.scene.depth_source)
                parts = [pixel_points(*pair) for pair in zip(views, maps, strict=True)]
                points = combine(parts, torch.cat)
                points = points.at_most(options.init_points, self.generator)
                self.scene.record["init"] = f"{len(points)} points of the depth source"
            case _:
                found = triangulate_points(views)
                missing = max(options.init_points - len(found), 0)
                drawn = random_points(cameras, missing, self.generator)
                points = combine([found, drawn], torch.cat)
                self.scene.record["init"] = (
                    f"{len(found)} points triangulated from the inputs, {missing} random"
                )
        return points.at_most(options.max_gaussians, self.generator)

    def modules(self) -> Sequence[tuple[nn.Module, float, float]]:
        """What is learnt beside the Gaussians, with first and last learning rate."""
        return ()

    def camera(self, index: int) -> Camera:
        """The camera of an input view."""
        return self.cameras[index]

    def target_cameras(self, cameras: Camera) -> Camera:
        """Cameras of the frame, as the trained Gaussians are to be drawn from."""
        return cameras

    def colors(self, parameters: GaussianParameters, camera: Camera) -> Float[Tensor, "n 3"] | None:
        """Colours instead of the spherical harmonics, or None."""
        return None

    def baked(self, parameters: GaussianParameters) -> GaussianParameters:
        """The Gaussians with colours that spherical harmonics hold: those of `colors`, where there
        are such, as the inputs see them on the mean.
        """
        cameras = [self.camera(index) for index in range(len(self.cameras))]
        seen = [self.colors(parameters, camera) for camera in cameras]
        colors = [each for each in seen if each is not None]
        if not colors:
            return parameters
        mean = torch.stack(colors).mean(0)
        return replace(
            parameters, sh_dc=rgb_to_sh(mean)[:, None], sh_rest=torch.zeros_like(parameters.sh_rest)
        )

    def draw(
        self, parameters: GaussianParameters, camera: Camera, progress: float = 1.0
    ) -> Drawing:
        """What a camera sees of the Gaussians after a share of the training."""
        bands = int(progress * self.options.full_iterations / self.options.sh_every)
        return draw(
            self._rasterize,
            parameters.gaussians(),
            camera,
            self.background,
            min(bands, self.options.sh_degree),
            self.colors(parameters, camera),
        )

    def steps(self, training: Training) -> Sequence[OptimiserStep]:
        """The optimiser's steps of one iteration."""
        return (self.photometric_step,)

    def photometric_step(self, training: Training, index: int) -> Objective:
        """The photograph's loss and whatever the method adds to it."""
        progress = training.iteration / self.options.iterations
        drawing = self.draw(training.optimiser.parameters, self.camera(index), progress)
        loss = photometric_loss(
            drawing.image,
            self._photographs[index],
            ssim_weight=self.options.ssim_weight,
            l1_weight=self.options.l1_weight,
        )
        return Objective(loss + self.regulariser(training, index, drawing), drawing)

    def regulariser(
        self, training: Training, index: int, drawing: Drawing
    ) -> Float[Tensor, ""] | float:
        """What the method adds to the photometric loss."""
        return 0.0

    def grow(self, training: Training) -> None:
        """Add Gaussians where the statistics ask for them."""
        if grow(training.optimiser, training.statistics, self.options, training.generator):
            self.scene.record["growth"] = f"stopped at {self.options.max_gaussians} Gaussians"

    def adapt(self, training: Training) -> None:
        """Change the number of Gaussians and their opacities, where the schedule says so."""
        options, schedule, step = self.options, training.schedule, training.iteration
        if step >= schedule.at(options.densify_until):
            return
        if step > schedule.at(options.densify_from) and schedule.due(
            step, options.densify_from, options.densify_every, MIN_BETWEEN_GROWTH
        ):
            self.grow(training)
            was_reset = options.reset_every > 0 and step > schedule.at(options.reset_first)
            prune(training.optimiser, training.statistics, options, large_too=was_reset)
            training.statistics = GrowthStatistics.empty(training.optimiser.parameters.means)
        if schedule.due(step, options.reset_first, options.reset_every, MIN_BETWEEN_RESETS):
            reset_opacity(training.optimiser, options.reset_opacity)
