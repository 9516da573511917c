"""The view from a pose: posed views with depth in, pictures at the queries out."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.config import SamplerConfig
from extrap_train.data.examples import query_batch
from extrap_train.device import autocast
from extrap_train.diffusion.model import ExtrapolationModel
from extrap_train.diffusion.sampler import sample_views
from extrap_train.geometry.warp import compute_warp
from extrap_train.views import Camera, View, Warp, combine


@dataclass(frozen=True)
class GeneratedViews:
    """Pictures at the queries, and what they were made from."""

    images: Float[Tensor, "n 3 h w"]
    """In [0, 1]."""
    cameras: Camera
    """The queries at the pictures' size: the largest centred square of what was asked for."""
    warp: Warp
    """What the references show of each query."""
    references: list[tuple[int, ...]]
    """Indices of the views that each query was warped from, nearest first."""


@runtime_checkable
class ViewGenerator(Protocol):
    """Whatever can generate a scene's view from any pose; a test's oracle is one too."""

    @property
    def image_size(self) -> int:
        """Side of the square pictures, in pixels."""
        ...

    @property
    def warp_size(self) -> int:
        """Side of the square views that it warps from, in pixels."""
        ...

    def generate(
        self, references: Sequence[View], queries: Camera, names: Sequence[str], seed: int = 0
    ) -> GeneratedViews:
        """Pictures of the queries (batched once), from views that have depth.

        A query's noise follows from `seed` and its name alone: the picture depends neither on the
        other queries nor on their number. Raises InputError for degenerate cameras, for views
        without depth, and where what is generated is not finite.
        """
        ...


@dataclass(frozen=True)
class DiffusionGenerator:
    """Samples the views with a diffusion model, each from its nearest references."""

    model: ExtrapolationModel
    sampler: SamplerConfig
    batch_size: int = 16
    """Queries that are denoised at a time."""
    references: int | None = None
    """Most views that a query is warped from; None takes the model's number."""
    precision: str = "32-true"
    """What the network computes in, by the names of `trainer.precision`."""

    @property
    def image_size(self) -> int:
        """See `ViewGenerator.image_size`."""
        return self.model.config.image_size

    @property
    def warp_size(self) -> int:
        """See `ViewGenerator.warp_size`."""
        return self.model.config.warp_size

    def generate(
        self, references: Sequence[View], queries: Camera, names: Sequence[str], seed: int = 0
    ) -> GeneratedViews:
        """See `ViewGenerator.generate`."""
        if len(names) != len(queries.world_to_cam):
            raise ValueError(f"{len(names)} names for {len(queries.world_to_cam)} queries")
        batches = [slice(at, at + self.batch_size) for at in range(0, len(names), self.batch_size)]
        parts = [self._generate(references, queries[at], names[at], seed) for at in batches]
        whole = combine(parts, torch.cat)
        chosen = [row for part in parts for row in part.references]
        return GeneratedViews(whole.images, whole.cameras, whole.warp, chosen)

    def _generate(
        self, references: Sequence[View], queries: Camera, names: Sequence[str], seed: int
    ) -> GeneratedViews:
        config = self.model.config
        size, most = config.warp_size, self.references or config.num_condition_views
        device = next(self.model.parameters()).device
        # Geometry keeps its precision where the network runs in less.
        with torch.autocast(device.type, enabled=False):
            batch, chosen = query_batch(references, queries, most, size)
            batch = compute_warp(batch.to(device), config.image_size)
        with autocast(device, self.precision):
            images = sample_views(self.model, batch, self.sampler, names, seed)
        assert batch.warp is not None
        made = GeneratedViews(images, batch.camera, batch.warp, chosen)
        return combine([made], lambda tensors: tensors[0].cpu())
