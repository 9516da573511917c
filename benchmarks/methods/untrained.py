"""What needs no training: the rows that a trained method has to beat."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from benchmarks.methods.base import (
    SceneInputs,
    Stopwatch,
    Synthesis,
    photographs_used,
    views_with_depth,
)
from extrap_train.config.options import option
from extrap_train.data.examples import query_batch
from extrap_train.diffusion.evaluation import inpainted_warp
from extrap_train.geometry.viewpoints import references_by_nearness
from extrap_train.geometry.warp import compute_warp
from extrap_train.views import stack_cameras


@dataclass(frozen=True)
class NearestPhoto:
    """The input photograph nearest to the target, as it is."""

    def weight_files(self, category: str) -> Sequence[Path]:
        """No files: nothing is trained."""
        return ()

    def synthesize(self, inputs: SceneInputs) -> Synthesis:
        """The nearest input's image for every target."""
        with Stopwatch() as watch:
            cameras = stack_cameras([view.camera for view in inputs.views])
            nearest = references_by_nearness(cameras, inputs.targets)[:, 0]
            images = torch.stack([inputs.views[index].image for index in nearest])
        return Synthesis(
            images,
            watch.seconds / len(images),
            {"depth": "not used"} | photographs_used(inputs.views),
        )


@dataclass(frozen=True)
class InpaintedWarp:
    """The fused warp of the nearest inputs, its holes inpainted (Telea 2004)."""

    references: int = option(3, "most inputs that a target is warped from", low=1)

    def weight_files(self, category: str) -> Sequence[Path]:
        """No files: nothing is trained."""
        return ()

    def synthesize(self, inputs: SceneInputs) -> Synthesis:
        """Warp and inpaint every target."""
        with Stopwatch() as watch:
            views, size = views_with_depth(inputs), inputs.targets.height
            batch = query_batch(views, inputs.targets, self.references, views[0].camera.height)[0]
            batch = compute_warp(batch, size)
            assert batch.warp is not None
            images = inpainted_warp(batch.warp).clamp(0, 1)
        given = {"depth": "used"} | photographs_used(views)
        return Synthesis(images, watch.seconds / len(images), given)
