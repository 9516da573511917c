"""Pairs of a scene's input views, and of references beside them: what a model is adapted with."""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
import torch

from extrap_train.data.examples import Example, collate
from extrap_train.data.virtual_references import VirtualReference, virtual_references
from extrap_train.errors import InputError
from extrap_train.geometry.viewpoints import extra_references, pairwise_angles, scene_center
from extrap_train.views import PairBatch, View, stack_cameras

Pair = tuple[int, int]
"""(query, its nearest reference), by their places among the views."""


@runtime_checkable
class AdaptationPairs(Protocol):
    """Training examples of one scene, and some that are kept out of them."""

    def counts(self) -> dict[str, int]:
        """How many pairs there are, and how many are trained on."""
        ...

    def training_batch(self, size: int, rng: np.random.Generator) -> PairBatch:
        """Pairs drawn without repetition as far as they go."""
        ...

    def held_out_batch(self) -> PairBatch:
        """What is held out, the same at every call."""
        ...


def adaptation_pairs(
    views: Sequence[View], most_references: int, virtual: int, seed: int
) -> AdaptationPairs:
    """Pairs with `virtual` references beside each view; with 0, those among the views themselves.

    Views are square, of one size, and have depth. InputError for a single view.
    """
    if virtual:
        return VirtualPairs(views, most_references, virtual, seed)
    return ScenePairs(views, most_references)


class ScenePairs:
    """All N(N − 1) pairs of N posed views with depth (METHOD section 4).

    The pair with the best score cos α·(1 − cos α), the likest to what is asked for later, is held
    out, and with it its query: a view that is trained towards says nothing about others.
    """

    def __init__(self, views: Sequence[View], most_references: int) -> None:
        self._views = _Inputs(views)
        self.most_references = most_references
        places = range(len(views))
        pairs = [(query, reference) for query in places for reference in places]
        self.all = [(query, reference) for query, reference in pairs if query != reference]
        self.held_out = max(self.all, key=self._score)
        self.training = [pair for pair in self.all if pair[0] != self.held_out[0]]

    def _score(self, pair: Pair) -> float:
        cosine = np.cos(self._views.angles_rad[pair])
        return float(cosine * (1 - cosine))

    def counts(self) -> dict[str, int]:
        """See `AdaptationPairs.counts`."""
        return {"all": len(self.all), "trained": len(self.training)}

    def training_batch(self, size: int, rng: np.random.Generator) -> PairBatch:
        """See `AdaptationPairs.training_batch`; each has one to `most_references` references."""
        drawn = _draw_indices(len(self.training), size, rng)
        counts = rng.integers(1, self.most_references + 1, size)
        examples = [
            self._example(self.training[place], int(count), rng)
            for place, count in zip(drawn, counts, strict=True)
        ]
        return collate(examples, self.most_references)

    def held_out_batch(self) -> PairBatch:
        """The held-out pair, with all the references that it can have."""
        rng = np.random.default_rng(0)
        example = self._example(self.held_out, self.most_references, rng)
        return collate([example], self.most_references)

    def _example(self, pair: Pair, count: int, rng: np.random.Generator) -> Example:
        query, first = pair
        places = np.arange(len(self._views.images))
        angles = self._views.angles_rad
        further = extra_references(angles, query, first, count, rng, places)
        return self._views.example(query, [], [first, *further])


class VirtualPairs:
    """Every view as the query of references that were warped beside it.

    Few inputs stand far apart: their own pairs ask for what none of the references shows, which
    teaches to invent. Later queries stand between the inputs; so do these references, whose warps
    have the holes and the seams that are to be painted, and the truth is a photograph.

    Of every view one reference, in the middle of their angles, is held out. No view is: with three
    inputs, what is learnt of two says nothing of the third, and all three are to be learnt.
    """

    def __init__(
        self, views: Sequence[View], most_references: int, virtual: int, seed: int
    ) -> None:
        self._views = _Inputs(views)
        self.most_references = most_references
        self.all = virtual_references(views, virtual, seed)
        middle = virtual // 2
        self.held_out = self.all[middle::virtual]
        self.training = [pair for i, pair in enumerate(self.all) if i % virtual != middle]

    def counts(self) -> dict[str, int]:
        """See `AdaptationPairs.counts`."""
        return {"all": len(self.all), "trained": len(self.training)}

    def training_batch(self, size: int, rng: np.random.Generator) -> PairBatch:
        """See `AdaptationPairs.training_batch`; inputs farther than it stand beside a reference."""
        drawn = _draw_indices(len(self.training), size, rng)
        examples = [self._example(self.training[place], rng) for place in drawn]
        return collate(examples, self.most_references)

    def held_out_batch(self) -> PairBatch:
        """The held-out reference of every view."""
        rng = np.random.default_rng(0)
        examples = [self._example(pair, rng) for pair in self.held_out]
        return collate(examples, self.most_references)

    def _example(self, pair: VirtualReference, rng: np.random.Generator) -> Example:
        angles = self._views.angles_rad[pair.query]
        places = np.arange(len(angles))
        behind = places[(places != pair.query) & (angles >= pair.angle_rad)]
        count = int(rng.integers(0, min(self.most_references - 1, len(behind)) + 1))
        further = sorted(rng.permutation(behind)[:count].tolist(), key=lambda view: angles[view])
        return self._views.example(pair.query, [pair.view], further)


def _draw_indices(count: int, size: int, rng: np.random.Generator) -> list[int]:
    """`size` of `count` places, each as often as any other but for the last round."""
    rounds = -(-size // count)
    return np.concatenate([rng.permutation(count) for _ in range(rounds)])[:size].tolist()


class _Inputs:
    """The views side by side, and the angles between them."""

    def __init__(self, views: Sequence[View]) -> None:
        if len(views) < 2:
            raise InputError(
                f"the scene has {len(views)} input view, and pairs need at least two; give more "
                "photographs, or use the model as it is (task=view)"
            )
        self.images = torch.stack([view.image for view in views])
        self.depths = torch.stack([_depth(view) for view in views])
        self.cameras = stack_cameras([view.camera for view in views])
        self.angles_rad = pairwise_angles(self.cameras, scene_center(self.cameras))

    def example(self, query: int, before: Sequence[View], places: Sequence[int]) -> Example:
        """A view as the query of other views: those given, then those at the places."""
        chosen = torch.tensor(places, dtype=torch.long)
        cameras = [*(view.camera for view in before), *(self.cameras[place] for place in places)]
        return Example(
            self.images[query],
            self.cameras[query],
            torch.cat([*(view.image[None] for view in before), self.images[chosen]]),
            stack_cameras(cameras),
            torch.cat([*(_depth(view)[None] for view in before), self.depths[chosen]]),
        )


def _depth(view: View) -> torch.Tensor:
    if view.depth is None:
        raise InputError(f"view {view.name}: has no depth; use depth=stereo, which estimates it")
    return view.depth
