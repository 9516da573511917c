"""The one training loop of all Gaussian methods: 3DGS (Kerbl et al., 2023)."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.depth import DepthSource
from extrap_train.errors import InputError
from extrap_train.gaussians.density import GrowthStatistics
from extrap_train.gaussians.gaussian_model import GaussianParameters, Gaussians
from extrap_train.gaussians.gaussian_options import GaussianOptions, Schedule, exponential
from extrap_train.gaussians.init import Points, parameters_from_points
from extrap_train.gaussians.optimiser import GaussianOptimiser, ModuleOptimiser, is_finite
from extrap_train.gaussians.recipe import Recipe, Training
from extrap_train.gaussians.training_scene import training_scene
from extrap_train.geometry.cameras import unproject_to_world
from extrap_train.terminal import track
from extrap_train.views import Camera, View, combine

WIDEST_START = 0.05
"""Largest initial width as a share of the distance to the nearest input camera: among a few hundred
scattered points neighbours are so far that each Gaussian would cover a whole image, which is slow
and shows nothing.
"""
FARTHEST = 1e5
"""Distance from the scene's centre, in extents, that no Gaussian reaches on purpose."""
SURFACE_ALPHA = 0.5
"""Least opacity of a pixel that shows a surface; with less it shows mostly what is behind."""


class Diverged(InputError):
    """The optimisation left the scene, or finite numbers altogether: there is no result."""


@dataclass(frozen=True)
class Fit:
    """A trained scene, on the device that it was fitted on; what it gives is on the CPU."""

    parameters: GaussianParameters
    recipe: Recipe

    @torch.no_grad()
    def render(self, targets: Camera) -> Float[Tensor, "n 3 h w"]:
        """The images of cameras of the world (batched `n`), in [0, 1]."""
        cameras = self.recipe.scene.frame.inside(targets).to(self.recipe.options.device)
        cameras = self.recipe.target_cameras(cameras)
        count = len(targets.world_to_cam)
        drawn = [self.recipe.draw(self.parameters, cameras[i]).image for i in range(count)]
        return torch.stack(drawn).clamp(0, 1).cpu()

    @property
    def record(self) -> dict[str, str]:
        """What was used and what happened, in words."""
        return self.recipe.scene.record

    @torch.no_grad()
    def seen_surface(self) -> Float[Tensor, "m 3"]:
        """The surface that the inputs see, in the world: a point for every pixel of theirs with an
        alpha above `SURFACE_ALPHA`, on its ray at the expected depth.

        The Gaussians' own centres would not do: after a short optimisation nearly all are faint,
        and only together they hide what is behind.
        """
        points = []
        for index in range(len(self.recipe.cameras)):
            camera = self.recipe.camera(index)
            drawing = self.recipe.draw(self.parameters, camera)
            on_rays = unproject_to_world(drawing.depth, camera)
            points.append(on_rays[drawing.alpha > SURFACE_ALPHA])
        return self.recipe.scene.frame.points_outside(torch.cat(points)).cpu()

    @torch.no_grad()
    def gaussians(self) -> Gaussians:
        """The Gaussians in the world that the input views were given in.

        A network's colours are baked: the mean of what the inputs see, the same from everywhere.
        """
        frame = self.recipe.scene.frame
        drawn = self.recipe.baked(self.parameters).gaussians()
        return Gaussians(
            frame.points_outside(drawn.means), drawn.quats, drawn.scales * frame.unit,
            drawn.opacities, drawn.sh,
        ).to("cpu")  # fmt: skip


def fit(recipe: Recipe, points: Points | None = None, show_progress: bool = False) -> Fit:
    """Optimise Gaussians until they look like the photographs (3DGS, algorithm 1).

    Starts from the recipe's own points, or from those given (in the frame, on the CPU). The same
    recipe, points and seed give the same Gaussians on a CPU. Raises InputError without usable
    points, `Diverged` where the loss or anything that is learnt stops being finite.
    """
    options, scene = recipe.options, recipe.scene
    training = _begin(recipe, recipe.initial_points() if points is None else points)
    optimiser, schedule = training.optimiser, training.schedule
    modules = ModuleOptimiser(recipe.modules(), schedule)
    order: list[int] = []
    count = options.iterations
    iterations = range(1, count + 1)
    for iteration in track(iterations, "fitting Gaussians", count, "it", shown=show_progress):
        training.iteration = iteration
        order = order or torch.randperm(len(scene.views), generator=training.generator).tolist()
        index = order.pop()  # every photograph once before any comes again
        progress = iteration / count
        optimiser.set_rate("means", learning_rates(options, schedule, progress)["means"])
        for step in recipe.steps(training):  # of 3DGS: the photometric one alone
            objective = step(training, index)  # (1 − λ)·L1 + λ·(1 − SSIM), equation 7
            if not objective.loss.detach().isfinite():
                raise _diverged(f"the loss became {float(objective.loss)}", training)
            objective.loss.backward()
            if objective.drawing is not None:
                training.statistics.add_drawing(objective.drawing)
            optimiser.step(recipe.means_factor)
            modules.step(progress)
            if not optimiser.parameters.means.detach().abs().max() < FARTHEST:
                raise _diverged("a Gaussian left the scene", training)
        _check(training, modules)
        recipe.adapt(training)  # clone, split, prune and reset opacities, section 5.2
    _check(training, modules)
    return Fit(combine([optimiser.parameters], lambda tensors: tensors[0].detach()), recipe)


def _begin(recipe: Recipe, points: Points) -> Training:
    options, scene = recipe.options, recipe.scene
    schedule = Schedule(options.iterations, options.full_iterations)
    eyes = torch.stack([view.camera.center for view in scene.views])
    widest = WIDEST_START * torch.cdist(points.positions, eyes).amin(1)
    parameters = parameters_from_points(points, options.sh_degree, options.init_opacity, widest)
    parameters = parameters.to(options.device)
    optimiser = GaussianOptimiser(parameters, learning_rates(options, schedule, progress=0.0))
    scene.record["schedule"] = (
        f"{options.iterations} of {options.full_iterations} iterations, "
        f"learning rates x {schedule.rate_factor:.3g}"
    )
    statistics = GrowthStatistics.empty(parameters.means)
    return Training(optimiser, statistics, schedule, recipe.generator)


def learning_rates(
    options: GaussianOptions, schedule: Schedule, progress: float
) -> dict[str, float]:
    """Adam's learning rate of each parameter after a share of the training."""
    factor = schedule.rate_factor
    means = exponential(options.means_rate, options.means_rate_final, progress)
    return {
        "means": means * factor,
        "log_scales": options.log_scales_rate * factor,
        "quats": options.quats_rate * factor,
        "opacity_logits": options.opacity_logits_rate,
        "sh_dc": options.sh_dc_rate * factor,
        "sh_rest": options.sh_rest_rate * factor,
    }


def _check(training: Training, modules: ModuleOptimiser) -> None:
    """What a loss of finite numbers can hide: a Gaussian that is NaN is not drawn."""
    for name, values in training.optimiser.parameters.tensors().items():
        if not is_finite(values):
            raise _diverged(f"{name} stopped being finite", training)
    if not modules.is_finite():
        raise _diverged("what is learnt beside the Gaussians stopped being finite", training)


def _diverged(what: str, training: Training) -> Diverged:
    return Diverged(
        f"{what} in iteration {training.iteration} of {training.schedule.iterations}; "
        "lower the learning rates or check the input"
    )


def fit_views(
    views: Sequence[View], depth_source: DepthSource, options: GaussianOptions, seed: int
) -> Fit:
    """Plain 3DGS of posed views, with a progress bar; `Fit.gaussians()` is what a PLY holds.

    `options.init="dense"` starts from the depth source's points, which is best where views carry
    depth. InputError for views or points that cannot be used, `Diverged` where training fails.
    """
    return fit(Recipe(options, training_scene(views, depth_source, seed)), show_progress=True)
