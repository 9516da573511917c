"""Pairs of a scene's input views, and of references beside them: what a model is adapted with."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from extrap_train.data.examples import Example, collate, query_batch
from extrap_train.depth import require_depth
from extrap_train.errors import InputError
from extrap_train.geometry.resample import fill_holes
from extrap_train.geometry.viewpoints import (
    camera_centers,
    common_center,
    extra_references,
    pairwise_angles,
    scene_center,
    turn_camera,
)
from extrap_train.geometry.warp import compute_warp
from extrap_train.views import PairBatch, View, stack_cameras

_NEAREST_RAD, _FARTHEST_RAD = np.deg2rad([10, 60])
"""Angles that a reference stands beside its query at: about those that are asked for later."""


class AdaptationPairs(ABC):
    """Training examples of one scene, and some that are kept out of them."""

    all: Sequence[Any]
    training: Sequence[Any]
    held_out: Sequence[Any]

    def __init__(self, views: Sequence[View], most_references: int) -> None:
        if len(views) < 2:
            raise InputError(
                f"the scene has {len(views)} input view, and pairs need at least two; give more "
                "photographs, or use the model as it is (task=view)"
            )
        self.most_references = most_references
        self.images = torch.stack([view.image for view in views])
        self.depths = torch.stack([require_depth(view) for view in views])
        self.cameras = stack_cameras([view.camera for view in views])
        self.angles_rad = pairwise_angles(self.cameras, scene_center(self.cameras))

    @abstractmethod
    def example(self, pair: Any, rng: np.random.Generator, most: int) -> Example:
        """A pair with further references, with the pair's own at most `most` of them."""

    def counts(self) -> dict[str, int]:
        """How many pairs there are, and how many are trained on."""
        return {"all": len(self.all), "trained": len(self.training)}

    def training_batch(self, size: int, rng: np.random.Generator) -> PairBatch:
        """`size` training pairs, each as often as any other but for the last round."""
        count = len(self.training)
        drawn = np.concatenate([rng.permutation(count) for _ in range(-(-size // count))])[:size]
        most = rng.integers(1, self.most_references + 1, size)
        examples = [
            self.example(self.training[index], rng, int(limit))
            for index, limit in zip(drawn, most, strict=True)
        ]
        return collate(examples, self.most_references)

    def held_out_batch(self) -> PairBatch:
        """What is held out, the same at every call."""
        rng, most = np.random.default_rng(0), self.most_references
        return collate([self.example(pair, rng, most) for pair in self.held_out], most)

    def pair_example(self, query: int, before: Sequence[View], places: Sequence[int]) -> Example:
        """A view as the query of other views: those given, then those at the places."""
        chosen = torch.tensor(places, dtype=torch.long)
        cameras = [*(view.camera for view in before), *(self.cameras[place] for place in places)]
        return Example(
            self.images[query],
            self.cameras[query],
            torch.cat([*(view.image[None] for view in before), self.images[chosen]]),
            stack_cameras(cameras),
            torch.cat([*(require_depth(view)[None] for view in before), self.depths[chosen]]),
        )


def adaptation_pairs(
    views: Sequence[View], most_references: int, virtual: int, seed: int
) -> AdaptationPairs:
    """Pairs with `virtual` references beside each view; with 0, those among the views themselves.

    Views are square, of one size, and have depth. InputError for a single view.
    """
    if virtual:
        return VirtualPairs(views, most_references, virtual, seed)
    return ScenePairs(views, most_references)


class ScenePairs(AdaptationPairs):
    """All N(N − 1) pairs (query, nearest reference) of N posed views.

    The pair with the best score cos α·(1 − cos α), the most similar to later queries, is held
    out, and with it its query: a view that is trained towards says nothing about others.
    """

    def __init__(self, views: Sequence[View], most_references: int) -> None:
        super().__init__(views, most_references)
        places = range(len(views))
        self.all = [(q, r) for q in places for r in places if q != r]
        cosine = np.cos(self.angles_rad)
        score = cosine * (1 - cosine)
        best = max(self.all, key=lambda pair: float(score[pair]))
        self.held_out = [best]
        self.training = [pair for pair in self.all if pair[0] != best[0]]

    def example(self, pair: tuple[int, int], rng: np.random.Generator, most: int) -> Example:
        """The pair, and references further from the query, spread around the scene."""
        places = np.arange(len(self.images))
        further = extra_references(self.angles_rad, *pair, most, rng, places)
        return self.pair_example(pair[0], [], [pair[1], *further])


@dataclass(frozen=True)
class VirtualReference:
    """A view that stands beside one of the inputs, the query that it is a reference of."""

    view: View
    """Warped from its query. Depth is 0 where that does not reach; the image is filled there."""
    query: int
    angle_rad: float


class VirtualPairs(AdaptationPairs):
    """Every view as the query of references that were warped beside it.

    Few inputs stand far apart: their own pairs ask for what none of the references shows, which
    teaches to invent. Later queries stand between the inputs; so do these references, whose warps
    have the holes and the seams that are to be generated, and the truth is a photograph.

    Of every view one reference, in the middle of their angles, is held out. No view is: with three
    inputs, what is learnt of two says nothing of the third, and all three are to be learnt.
    """

    def __init__(
        self, views: Sequence[View], most_references: int, virtual: int, seed: int
    ) -> None:
        super().__init__(views, most_references)
        self.all = virtual_references(views, virtual, seed)
        middle = virtual // 2
        self.held_out = self.all[middle::virtual]
        self.training = [pair for i, pair in enumerate(self.all) if i % virtual != middle]

    def example(self, pair: VirtualReference, rng: np.random.Generator, most: int) -> Example:
        """The reference, and inputs that are farther from the query than it."""
        angles = self.angles_rad[pair.query]
        behind = np.flatnonzero(angles >= pair.angle_rad)
        further = rng.permutation(behind[behind != pair.query])[: most - 1].tolist()
        further.sort(key=lambda view: angles[view])
        return self.pair_example(pair.query, [pair.view], further)


def virtual_references(views: Sequence[View], count: int, seed: int) -> list[VirtualReference]:
    """`count` references beside each of the views (square, all of one size, with depth).

    They are turned about the scene's vertical by angles that are drawn evenly between 10 and 60
    degrees, to both sides in turn, and see what their own view sees. The other views are left out:
    where exposures differ, or depth is estimated, they teach to blur. Deterministic in the seed.
    """
    cameras = stack_cameras([view.camera for view in views])
    pivots = _pivots(views)
    # Where the images' up points on average; two cameras do not say more of their orbit.
    up = -cameras.world_to_cam[:, 1, :3].double().numpy(force=True).mean(0)
    length = np.linalg.norm(up)
    axis = up / length if length > 0 else np.array([0.0, -1.0, 0.0])
    rng = np.random.default_rng(seed)
    made: list[VirtualReference] = []
    for query, view in enumerate(views):
        shares = (np.arange(count) + rng.uniform(size=count)) / count
        angles = _NEAREST_RAD + (_FARTHEST_RAD - _NEAREST_RAD) * shares
        sides = np.where(np.arange(count) % 2, 1.0, -1.0)
        turned = turn_camera(view.camera, pivots[query], axis, angles * sides)
        batch, _ = query_batch([view], turned, 1, view.camera.height)
        warp = compute_warp(batch).warp
        assert warp is not None
        images = fill_holes(warp.image, warp.mask).clamp(0, 1)
        made += [
            VirtualReference(View(images[i], turned[i], warp.depth[i]), query, float(angles[i]))
            for i in range(count)
        ]
    return made


def _pivots(views: Sequence[View]) -> list[Float[np.ndarray, "3"]]:
    """What each view is turned about: the scene's centre; where they have none in common, the
    point in the middle of its image at its median depth.
    """
    cameras = stack_cameras([view.camera for view in views])
    center = common_center(cameras)
    if center is not None:
        return [center] * len(views)
    forward = cameras.forward.double().numpy(force=True)
    known = [depth[depth > 0] for depth in map(require_depth, views)]
    depths = np.array([float(depth.median()) if len(depth) else 1.0 for depth in known])
    return list(camera_centers(cameras) + depths[:, None] * forward)
