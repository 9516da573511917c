"""FSGS (Zhu et al., 2024): few-shot view synthesis by unpooling and monocular depth."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from benchmarks.methods.threedgs import MonocularMethod
from extrap_train.config.options import option
from extrap_train.errors import InputError
from extrap_train.gaussians.gaussian_model import GaussianParameters
from extrap_train.gaussians.init import nearest_neighbours
from extrap_train.gaussians.losses import pearson_depth_loss
from extrap_train.gaussians.rasterize import Drawing
from extrap_train.gaussians.recipe import Recipe, Training
from extrap_train.gaussians.training_scene import TrainingScene
from extrap_train.views import Camera, View

NEIGHBOURS = 3


class FsgsRecipe(Recipe):
    """Depth correlation on inputs and pseudo views, and unpooling before the usual growth."""

    options: "Fsgs"

    def __init__(self, options: "Fsgs", scene: TrainingScene) -> None:
        super().__init__(options, scene)
        self._monocular, self._priors = options.priors(scene)
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
        new, limited = unpool(
            training.optimiser.parameters,
            options.unpool_proximity,
            options.unpool_scale,
            max(options.max_gaussians - count, 0),
        )
        training.optimiser.append(new)
        all_kept = new.means.new_ones(count, dtype=torch.bool)
        training.statistics.follow(all_kept, len(new))
        if limited:
            self.scene.record["unpooling"] = f"stopped at {options.max_gaussians} Gaussians"


@dataclass(frozen=True)
class Fsgs(MonocularMethod):
    """3DGS with unpooling, a depth correlation loss, and views that nobody photographed."""

    recipe = FsgsRecipe

    full_iterations: int = 10_000
    sh_every: int = 500
    densify_until: int = 10_000
    densify_gradient: float = 5e-4
    reset_first: int = 2001
    reset_opacity: float = 0.05

    unpool_until: int = option(2000, "last iteration with unpooling", low=0)
    unpool_proximity: float = option(
        0.01,
        "least mean squared distance to three neighbours, in squared extents (published: 5 in "
        "LLFF's squared units, which is above anything in a scene of extent 1)",
        low=0,
    )
    unpool_scale: float = option(
        0.05, "least scale of a source (published: 1 extent of LLFF's forward-facing rigs)", low=0
    )
    depth_weight: float = option(0.05, "weight of the depth correlation", low=0)
    late_depth_weight: float = option(0.001, "the same from late_from on", low=0)
    late_from: int = option(9500, "iteration from which there are no pseudo views", low=0)
    pseudo_from: int = option(2000, "iteration from which there are pseudo views", low=0)
    pseudo_every: int = option(10, "iterations between two pseudo views", low=1)
    pseudo_ramp: int = option(500, "iterations over which their weight grows", low=0)
    pseudo_weight: float = option(0.5, "weight of their depth correlation", low=0)


def unpool(
    parameters: GaussianParameters, proximity: float, scale: float, most: int
) -> tuple[GaussianParameters, bool]:
    """The Gaussians that fill the gaps between those already there, the most isolated sources'
    first and at most `most` of them; and whether there would have been more.

    A Gaussian is a source where the mean squared distance to its three neighbours exceeds
    `proximity` and its largest scale `scale`. On each edge from a source to a neighbour a new one
    is put in the middle, with the neighbour's scale and opacity, no rotation, and a colour of zero.
    The released code pairs sources 0 1 0 1 0 1 with the neighbours of 0 0 0 1 1 1, so that with
    several sources most edges lead to a stranger; this is the paper's pairing.
    """
    distance, index = nearest_neighbours(parameters.means, NEIGHBOURS)
    gap = distance.square().mean(1)
    sources = find_isolated(parameters, gap, proximity, scale)
    source, target = sources.repeat_interleave(NEIGHBOURS), index[sources].flatten()
    limited = len(source) > most
    source, target = source[:most], target[:most]
    means = parameters.means.detach()
    count = len(source)
    quats = torch.zeros(count, 4).to(means)
    quats[:, 0] = 1
    new = GaussianParameters(
        **{
            "means": (means[source] + means[target]) / 2,
            "log_scales": parameters.log_scales.detach()[target],
            "quats": quats,
            "opacity_logits": parameters.opacity_logits.detach()[target],
            "sh_dc": torch.zeros_like(parameters.sh_dc[target]),
            "sh_rest": torch.zeros_like(parameters.sh_rest[target]),
        }
    )
    return new, limited


def find_isolated(
    parameters: GaussianParameters, gap: Float[Tensor, " n"], proximity: float, scale: float
) -> Int[Tensor, " s"]:
    """Numbers of the Gaussians that are large and far from their neighbours, farthest first."""
    chosen = (gap > proximity) & (parameters.scales.detach().amax(1) > scale)
    order = gap.argsort(descending=True, stable=True)
    return order[chosen[order]]


def pseudo_camera(
    cameras: Sequence[Camera], generator: torch.Generator, jitter: float = 0.05
) -> Camera:
    """A camera between one input and the input nearest to it, looking at the same place.

    The position moves on the arc around the origin (the frame's centre) and is shifted by `jitter`
    times its distance at random; the viewing directions are averaged in the same share.
    """
    first = int(torch.randint(len(cameras), (1,), generator=generator))
    centers = torch.stack([camera.center for camera in cameras])
    distance = (centers - centers[first]).norm(dim=-1)
    distance[first] = math.inf
    a, b = cameras[first], cameras[int(distance.argmin())]
    share = float(torch.rand((), generator=generator))
    center = _on_arc(a.center, b.center, share)
    noise = torch.randn(3, generator=generator).to(center)
    center = center + jitter * center.norm() * noise
    forward = (1 - share) * a.forward + share * b.forward
    down = (1 - share) * a.world_to_cam[1, :3] + share * b.world_to_cam[1, :3]
    return replace(a, world_to_cam=_look_along(center, forward, down))


def _on_arc(a: Float[Tensor, "3"], b: Float[Tensor, "3"], share: float) -> Float[Tensor, "3"]:
    straight = (1 - share) * a + share * b
    radius = (1 - share) * a.norm() + share * b.norm()
    return straight / straight.norm().clamp_min(1e-6) * radius


def _look_along(
    center: Float[Tensor, "3"], forward: Float[Tensor, "3"], down: Float[Tensor, "3"]
) -> Float[Tensor, "4 4"]:
    """world_to_cam of a camera at `center`; `down` need not be square to `forward`."""
    z = forward / forward.norm()
    x = torch.linalg.cross(down, z)
    x = x / x.norm()
    rotation = torch.stack([x, torch.linalg.cross(z, x), z])
    world_to_cam = torch.eye(4).to(center)
    world_to_cam[:3, :3], world_to_cam[:3, 3] = rotation, -rotation @ center
    return world_to_cam
