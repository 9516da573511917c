"""What a method of the benchmark is given, and what it gives back.

A method is added with one file (a class with the two functions of `Method`) and one YAML under
`conf/method/` that names the class as `factory: package.module.Class` and may set its fields under
`options`. Options are the class's own fields: usually it is a frozen dataclass.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.depth import DepthSource
from extrap_train.errors import InputError
from extrap_train.views import Camera, View


class Unavailable(InputError):
    """A method cannot run here (weights, GPU or licence missing): its cells say so, with the
    reason, and the table goes on.
    """


@dataclass(frozen=True)
class SceneInputs:
    """All that a method knows of a scene: the same for every method of a cell's row.

    No field leads to the photographs behind `targets`.
    """

    category: str
    views: tuple[View, ...]
    """The input photographs with their cameras, in world units of the capture. They carry what
    `depth_source` found: ask it, not the views, for it charges what finding depth took.
    """
    targets: Camera
    """Batched `n`: where views are to be made. Inputs and targets have one image size."""
    depth_source: DepthSource
    seed: int
    """Seeds everything random; the same inputs and seed give the same images."""
    fine_views: tuple[View, ...]
    """The same photographs with their cameras and depth, `rules.fine_scale` times as large: for
    what would lose thin surfaces at the targets' size, such as a warp.
    """


@dataclass(frozen=True)
class Synthesis:
    """What a method made of a scene."""

    images: Float[Tensor, "n 3 h w"]
    """In [0, 1], one a target, in the order of `SceneInputs.targets`."""
    seconds: float = 0.0
    """Perform time as the paper defines it (III-A.2). A Gaussian method: preprocessing and
    optimisation. A diffusion method: generation and alignment, per image. `Stopwatch` takes it.
    """
    given: Mapping[str, str] = field(default_factory=dict)
    """What the method used of what it was given, for the result's row: where its geometry started,
    whether it touched the poses, and the like. Words, e.g. `{"init": "depth of the inputs"}`.
    """
    points: Float[Tensor, "m 3"] | None = None
    """The reconstructed surface in world units, where the method has one: for the 3-D metrics."""
    counts: Mapping[str, float] = field(default_factory=dict)
    """Further numbers for the result's row, e.g. `{"gaussians": 51234}`."""


def photographs_used(views: Sequence[View]) -> dict[str, str]:
    """For `Synthesis.given`: at what size the method took the inputs."""
    return {"photographs": f"{views[0].camera.width} px"}


def views_with_depth(inputs: SceneInputs) -> list[View]:
    """The inputs at their finer size with depth from the given source, 0 where it is unsure."""
    found = inputs.depth_source.depth_maps(inputs.fine_views)
    return [
        replace(view, depth=depth.reliable())
        for view, depth in zip(inputs.fine_views, found, strict=True)
    ]


@runtime_checkable
class Method(Protocol):
    """One row of a table."""

    def weight_files(self, category: str) -> Sequence[Path]:
        """Files that decide a category's images, besides the code; a cell's key covers their
        content.

        Raises `Unavailable` where one is missing, with its name and where it comes from.
        """
        ...

    def synthesize(self, inputs: SceneInputs) -> Synthesis:
        """Make the target views; raises `Unavailable` where this machine cannot."""
        ...


class Stopwatch:
    """Wall time of a `with` block, the accelerator's queue included."""

    seconds: float = 0.0

    def __enter__(self) -> "Stopwatch":
        _wait_for_device()
        self._started = time.perf_counter()
        return self

    def __exit__(self, *_: object) -> None:
        _wait_for_device()
        self.seconds += time.perf_counter() - self._started


def _wait_for_device() -> None:
    if torch.cuda.is_available():
        torch.cuda.synchronize()
