"""Training examples of the depth network, from captures whose depth is known."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from extrap_train.diffusion.generator import ViewGenerator
from extrap_train.geometry.viewpoints import references_by_nearness
from extrap_train.geometry.visibility import Ball
from extrap_train.reconstruction.depth_completion.observation import Observation, observe
from extrap_train.views import View, combine, stack_cameras

MOST_REFERENCES = 6
LARGEST_ERROR = 0.03
"""Of generated references' depth, relative, one standard deviation."""
NEXT_DEG = (20.0, 45.0)
"""Of most queries to the nearest known view; the others are anywhere."""
_KNOTS = 5
"""Of the smooth error field of a depth map, along each side."""
_HOLE_SHARE = 0.1


@dataclass(frozen=True)
class DepthExamples:
    """Observations with the truth."""

    seen: Observation
    log_depth: Float[Tensor, "b h w"]
    weight: Float[Tensor, "b h w"]
    """0 where the truth is unknown; highest on the object where no reference is certain."""


@dataclass(frozen=True)
class _Draw:
    """Frames in the order of the orbit."""

    query: int
    inputs: tuple[int, ...]
    references: tuple[int, ...]


def draw_examples(
    views: Sequence[View],
    generator: ViewGenerator | None,
    count: int,
    rng: np.random.Generator,
) -> DepthExamples:
    """Draw queries as completion comes to them: from neighbouring photographs on one side, and
    from those and views that were generated beside them.

    `views` follow one orbit and have depth and mask. With a generator, half of the queries'
    pictures are painted by it from the references, the others are true.
    """
    return combine(
        [_draw_example(views, generator, rng) for _ in range(count)],
        lambda tensors: torch.cat(list(tensors)),
    )


def _draw_example(
    views: Sequence[View], generator: ViewGenerator | None, rng: np.random.Generator
) -> DepthExamples:
    draw = _draw_frames(len(views), rng)
    order = references_by_nearness(
        stack_cameras([views[i].camera for i in draw.references]),
        stack_cameras([views[draw.query].camera]),
    )[0]
    # Stereo's depth of the photographs is not exact, nor is that of generated views.
    photo_error = rng.choice([0.0, 0.0, 0.005])
    painted_error = rng.choice([0.0, rng.uniform(0, LARGEST_ERROR)])
    references, confidences = [], []
    for index in (draw.references[i] for i in order):
        is_input = index in draw.inputs
        error = photo_error if is_input else painted_error
        view, confidence = _spoil(views[index], error, is_input=is_input, rng=rng)
        references.append(view)
        confidences.append(confidence)
    truth = views[draw.query]
    picture = truth.image
    if generator is not None and rng.random() < 0.5:
        cameras = stack_cameras([truth.camera])
        made = generator.generate(references, cameras, [truth.name], int(rng.integers(2**31)))
        picture = made.images[0]
    picture = _at_detail(picture, generator.image_size if generator else None, truth.image)
    cameras = stack_cameras([view.camera for view in references])
    seen = observe(
        picture[None],
        stack_cameras([truth.camera]),
        torch.stack([view.image for view in references])[None],
        torch.stack([_depth(view) for view in references])[None],
        torch.stack(confidences)[None],
        stack_cameras([cameras]),
        Ball.around(stack_cameras([view.camera for view in views])),
    )
    return with_truth(seen, truth)


def with_truth(seen: Observation, truth: View) -> DepthExamples:
    """One observation with the depth that it should lead to."""
    depth = _depth(truth)
    assert truth.mask is not None
    log_depth = (depth / seen.center_depth).clamp(min=1e-3).log()[None]
    uncertain = ~seen.certain[0]
    weight = 0.25 + 0.75 * uncertain + 4.0 * (uncertain & (truth.mask > 0.5))
    return DepthExamples(seen, log_depth, torch.where(depth > 0, weight, 0)[None])


def _draw_frames(frames: int, rng: np.random.Generator) -> _Draw:
    """Three to five neighbours are inputs; generated views have grown from both of their ends."""
    count = int(rng.integers(3, 6))
    first = int(rng.integers(frames))
    free = frames - count
    grown_before, grown_after = 0, 0
    if rng.random() < 0.6:
        grown_before, grown_after = (int(rng.integers(0, free // 2)) for _ in range(2))
    known = [(first + i) % frames for i in range(-grown_before, count + grown_after)]
    inputs = {(first + i) % frames for i in range(count)}
    near = max(1, round(frames * rng.uniform(*NEXT_DEG) / 360))
    ahead = near if rng.random() < 0.6 else int(rng.integers(1, frames))
    ahead = 1 + (ahead - 1) % (frames - len(known))
    query = (known[-1] + ahead) % frames if rng.random() < 0.5 else (known[0] - ahead) % frames
    wanted = int(rng.integers(1, MOST_REFERENCES + 1))
    gaps = [min((query - i) % frames, (i - query) % frames) for i in known]
    nearest = sorted(range(len(known)), key=lambda i: gaps[i])[:wanted]
    references = tuple(known[i] for i in nearest)
    return _Draw(query, tuple(i for i in references if i in inputs), references)


def _spoil(
    view: View, error: float, *, is_input: bool, rng: np.random.Generator
) -> tuple[View, Float[Tensor, "h w"]]:
    """The view with a smooth error of its depth, and the confidence it would have come with."""
    depth = _depth(view)
    if error == 0:
        sure = torch.ones_like(depth) if is_input else torch.full_like(depth, 0.9)
        return view, sure * (depth > 0)
    field = functional.interpolate(
        torch.from_numpy(rng.normal(size=(1, 1, _KNOTS, _KNOTS))).float(),
        depth.shape,
        mode="bicubic",
        align_corners=True,
    )[0, 0]
    spoiled = depth * (1 + error * field)
    if is_input:  # as stereo, which finds nothing in places
        holes = torch.from_numpy(rng.random((16, 16)) < _HOLE_SHARE).float()[None, None]
        holes = functional.interpolate(holes, depth.shape, mode="bilinear")[0, 0]
        spoiled = torch.where(holes > 0.5, 0, spoiled)
        confidence = torch.full_like(depth, float(rng.uniform(0.5, 1)))
    else:  # as painted at half the size
        half = [max(1, side // 2) for side in depth.shape]
        coarse = functional.interpolate(spoiled[None, None], half, mode="nearest-exact")
        spoiled = functional.interpolate(coarse, depth.shape, mode="nearest-exact")[0, 0]
        sure = (1 - (error * field).abs() / 0.04).clamp(0.1, 0.9)
        assert view.mask is not None
        confidence = torch.where(view.mask > 0.5, sure, 0.8)
    return replace(view, depth=spoiled), confidence * (spoiled > 0)


def _at_detail(
    picture: Float[Tensor, "3 h w"], size: int | None, like: Float[Tensor, "3 h2 w2"]
) -> Float[Tensor, "3 h2 w2"]:
    """The picture as large as another, with no more detail than `size` pixels a side show."""
    if size is not None and picture.shape[-1] != size:
        picture = functional.interpolate(picture[None], (size, size), mode="area")[0]
    if picture.shape == like.shape:
        return picture
    return functional.interpolate(picture[None], like.shape[-2:], mode="bicubic")[0].clamp(0, 1)


def _depth(view: View) -> Float[Tensor, "h w"]:
    assert view.depth is not None
    return view.depth
