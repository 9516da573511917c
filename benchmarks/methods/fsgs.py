"""FSGS (Zhu et al., 2024): few-shot view synthesis by unpooling and monocular depth."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.methods.gaussian_method import GaussianMethod
from extrap_train.errors import InputError
from extrap_train.gaussians.depth_losses import pearson_depth_loss
from extrap_train.gaussians.drawing import Drawing
from extrap_train.gaussians.priors import monocular_source, prior_depths
from extrap_train.gaussians.pseudo_views import pseudo_camera
from extrap_train.gaussians.recipe import Recipe, Training
from extrap_train.gaussians.scene import TrainingScene
from extrap_train.gaussians.unpool import Pairing, unpooled
from extrap_train.views import View


@dataclass(frozen=True)
class Fsgs(GaussianMethod):
    """3DGS with unpooling, a depth correlation loss, and views that nobody photographed."""

    full_iterations: int = 10_000
    sh_every: int = 500
    densify_until: int = 10_000
    densify_gradient: float = 5e-4
    reset_first: int = 2001
    reset_opacity: float = 0.05

    monocular: str = "surrogate"
    """Where monocular depth comes from: `surrogate` or `depth_source`."""
    pairing: Pairing = "paper"
    """Which ends an unpooled edge joins: the paper's, or those of the released code's mistake."""
    unpool_until: int = 2000
    unpool_proximity: float = 0.01
    """Least mean squared distance to three neighbours; in squared extents. Published: 5 in the
    squared units of LLFF's scenes, which is above anything in a scene of extent 1.
    """
    unpool_scale: float = 0.05
    """Least scale of a source, in extents. Published: 1 extent of LLFF's forward-facing rigs."""
    depth_weight: float = 0.05
    late_depth_weight: float = 0.001
    late_from: int = 9500
    pseudo_from: int = 2000
    pseudo_every: int = 10
    pseudo_ramp: int = 500
    pseudo_weight: float = 0.5

    def recipe(self, scene: TrainingScene) -> Recipe:
        """3DGS's with three additions."""
        return FsgsRecipe(self, scene)


class FsgsRecipe(Recipe):
    """Depth correlation on inputs and pseudo views, and unpooling before the usual growth."""

    options: Fsgs

    def __init__(self, options: Fsgs, scene: TrainingScene) -> None:
        super().__init__(options, scene)
        self._monocular = monocular_source(scene, options.monocular)
        self._priors = prior_depths(scene, self._monocular, options.device)
        # A source whose depth comes with the data has none for a view that was never photographed.
        self._predicts = self._monocular.image_size is not None
        scene.record["pseudo views"] = "yes" if self._predicts else "no: depth comes with the data"

    def regulariser(
        self, training: Training, index: int, drawing: Drawing
    ) -> Float[Tensor, ""] | float:
        """The depth losses of released code's train.py."""
        options, schedule, step = self.options, training.schedule, training.iteration
        late = step > schedule.at(options.late_from)
        weight = options.late_depth_weight if late else options.depth_weight
        loss = weight * pearson_depth_loss(drawing.depth, self._priors[index])
        begun = step - schedule.at(options.pseudo_from)
        if self._predicts and not late and begun > 0 and step % options.pseudo_every == 0:
            ramp = min(begun / max(schedule.at(options.pseudo_ramp), 1), 1.0)
            loss = loss + ramp * options.pseudo_weight * self._pseudo_loss(training)
        return loss

    def _pseudo_loss(self, training: Training) -> Float[Tensor, ""]:
        """The drawing's depth against what the network sees in the drawing, held fixed."""
        camera = pseudo_camera(self.cameras, training.generator)
        progress = training.iteration / self.options.iterations
        drawing = self.draw(training.optimiser.parameters, camera, progress)
        with torch.no_grad():
            seen = View(drawing.image.clamp(0, 1).cpu(), camera.to("cpu"))
            try:
                found = self._monocular.depth_map(seen, self.scene.views)
            except InputError as error:
                self.scene.record["pseudo views"] = f"some had no depth: {error}"
                return drawing.depth.sum() * 0
        return pearson_depth_loss(drawing.depth, found.reliable().to(drawing.depth))

    def grow(self, training: Training) -> None:
        """Grow as 3DGS does and, early in the training, unpool into the room that is left."""
        super().grow(training)
        if training.iteration < training.schedule.at(self.options.unpool_until):
            self._unpool(training)

    def _unpool(self, training: Training) -> None:
        options, count = self.options, len(training.optimiser)
        new, limited = unpooled(
            training.optimiser.parameters,
            options.unpool_proximity,
            options.unpool_scale,
            options.pairing,
            max(options.max_gaussians - count, 0),
        )
        training.optimiser.append(new)
        all_kept = new.means.new_ones(count, dtype=torch.bool)
        training.statistics.follow(all_kept, len(new))
        if limited:
            self.scene.record["unpooling"] = f"stopped at {options.max_gaussians} Gaussians"
