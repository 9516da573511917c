"""3D Gaussian Splatting (Kerbl et al., 2023), and what the methods that build on it share."""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.methods.base import (
    SceneInputs,
    Stopwatch,
    Synthesis,
    Unavailable,
    photographs_used,
)
from extrap_train.config.options import option
from extrap_train.depth import DepthMap, DepthSource, PointMaps
from extrap_train.device import fastest_device
from extrap_train.errors import InputError
from extrap_train.gaussians.fit import Fit, fit
from extrap_train.gaussians.gaussian_options import RASTERIZERS, GaussianOptions
from extrap_train.gaussians.init import Points, parameters_from_points
from extrap_train.gaussians.rasterize import rasterizer
from extrap_train.gaussians.recipe import Recipe
from extrap_train.gaussians.training_scene import TrainingScene, training_scene
from extrap_train.views import View


@dataclass(frozen=True)
class AffineSurrogate:
    """Another source's depth under an unknown affine map, a different one for each photograph.

    A perfect monocular network would say no more. Results that use this are marked as a
    surrogate's.
    """

    source: DepthSource
    seed: int = 0

    @property
    def image_size(self) -> int | None:
        """That of the source."""
        return self.source.image_size

    def depth_map(self, view: View, neighbours: Sequence[View]) -> DepthMap:
        """The source's depth `z` as `scale · z / median + shift`, 0 where it is unknown."""
        return self._apply_affine(view, self.source.depth_map(view, neighbours))

    def depth_maps(self, views: Sequence[View]) -> list[DepthMap]:
        """Every view's depth under its own map."""
        pairs = zip(views, self.source.depth_maps(views), strict=True)
        return [self._apply_affine(view, found) for view, found in pairs]

    def point_maps(self, first: View, second: View) -> PointMaps:
        """InputError: two affine depths have no frame in common."""
        raise InputError("monocular depth has no scale that two views share; use another depth=")

    def _apply_affine(self, view: View, found: DepthMap) -> DepthMap:
        photograph = np.ascontiguousarray(view.image.numpy(force=True))
        rng = np.random.default_rng([self.seed, zlib.crc32(photograph.tobytes())])
        scale, shift = float(rng.uniform(0.5, 2)), float(rng.uniform(0, 1))
        known = found.depth > 0
        if not known.any():
            return found
        mapped = scale * found.depth / found.depth[known].median() + shift
        return replace(found, depth=mapped * known)


_AUTO = "auto"
_CHOICES = (_AUTO, *RASTERIZERS)
_RASTERIZER_ON = {device: name for name, device in RASTERIZERS.items()}


@dataclass(frozen=True)
class ThreeDgs(GaussianOptions):
    """Fits Gaussians to the inputs, from points that these alone give, and draws the targets.

    The published method; it has no schedule for few views, so this is the one for many. A subclass
    has its own recipe.
    """

    recipe: ClassVar[type[Recipe]] = Recipe
    """What the method does in the training loop."""

    rasterizer: str = option(
        "auto",
        "numba on the CPU, gsplat on a GPU; auto: gsplat if there is a GPU",
        choices=_CHOICES,
    )

    def __post_init__(self) -> None:
        """Choose the rasteriser of this process's device; InputError for an option out of range."""
        super().__post_init__()
        if self.rasterizer == _AUTO:
            object.__setattr__(self, "rasterizer", _RASTERIZER_ON[fastest_device().type])

    def weight_files(self, category: str) -> Sequence[Path]:
        """No files: nothing is pre-trained."""
        return ()

    def fit_scene(self, inputs: SceneInputs) -> Fit:
        """The scene that the inputs alone make; the targets are not looked at."""
        scene = training_scene(inputs.views, inputs.depth_source, inputs.seed)
        return fit(self.recipe(self, scene))

    def synthesize(self, inputs: SceneInputs) -> Synthesis:
        """Fit, and draw every target; the time is that of preprocessing and optimisation.

        Raises Unavailable where the rasteriser cannot run.
        """
        try:
            rasterizer(self.rasterizer)
        except InputError as error:
            raise Unavailable(str(error)) from None
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
class MonocularMethod(ThreeDgs):
    """One that is also told a monocular network's depth, or what stands for it."""

    monocular: str = option(
        "surrogate",
        "monocular depth: the depth source under an unknown affine map, or as it is",
        choices=("surrogate", "depth_source"),
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
