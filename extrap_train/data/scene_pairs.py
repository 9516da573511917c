"""The ordered pairs of a scene's input views: what a model is adapted to the scene with."""

from collections.abc import Sequence

import numpy as np
import torch

from extrap_train.data.examples import Example, collate
from extrap_train.errors import InputError
from extrap_train.geometry.viewpoints import extra_references, pairwise_angles, scene_center
from extrap_train.views import PairBatch, View, stack_cameras

Pair = tuple[int, int]
"""(query, its nearest reference), by their places among the views."""


class ScenePairs:
    """All N(N − 1) pairs of N posed views with depth (METHOD section 4).

    The pair with the best score cos α·(1 − cos α), the likest to what is asked for later, is held
    out, and with it its query: a view that is trained towards says nothing about others.
    """

    def __init__(self, views: Sequence[View], most_references: int) -> None:
        if len(views) < 2:
            raise InputError(
                f"the scene has {len(views)} input view, and pairs need at least two; give more "
                "photographs, or use the model as it is (task=view)"
            )
        self.most_references = most_references
        self._images = torch.stack([view.image for view in views])
        self._cameras = stack_cameras([view.camera for view in views])
        self._depths = torch.stack([_depth(view) for view in views])
        self._angles = pairwise_angles(self._cameras, scene_center(self._cameras))
        places = range(len(views))
        pairs = [(query, reference) for query in places for reference in places]
        self.all = [(query, reference) for query, reference in pairs if query != reference]
        self.held_out = max(self.all, key=self._score)
        self.training = [pair for pair in self.all if pair[0] != self.held_out[0]]

    def _score(self, pair: Pair) -> float:
        cosine = np.cos(self._angles[pair])
        return float(cosine * (1 - cosine))

    def training_batch(self, size: int, rng: np.random.Generator) -> PairBatch:
        """Pairs drawn without repetition as far as they go, each with one to `k` references."""
        rounds = -(-size // len(self.training))
        order = np.concatenate([rng.permutation(len(self.training)) for _ in range(rounds)])
        counts = rng.integers(1, self.most_references + 1, size)
        return self._batch(
            [
                self._example(self.training[place], int(count), rng)
                for place, count in zip(order[:size], counts, strict=True)
            ]
        )

    def held_out_batch(self, copies: int) -> PairBatch:
        """The held-out pair, with all the references that it can have, `copies` times."""
        rng = np.random.default_rng(0)
        return self._batch([self._example(self.held_out, self.most_references, rng)] * copies)

    def _example(self, pair: Pair, count: int, rng: np.random.Generator) -> Example:
        query, first = pair
        places = np.arange(len(self._images))
        further = extra_references(self._angles, query, first, count, rng, places)
        chosen = torch.tensor([first, *further])
        return Example(
            self._images[query],
            self._cameras[query],
            self._images[chosen],
            self._cameras[chosen],
            self._depths[chosen],
        )

    def _batch(self, examples: list[Example]) -> PairBatch:
        return collate(examples, self.most_references)


def _depth(view: View) -> torch.Tensor:
    if view.depth is None:
        raise InputError(f"view {view.name}: has no depth; use depth=stereo, which estimates it")
    return view.depth
