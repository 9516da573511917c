"""Query views that nobody has photographed: posed views in, a batch without its truth out."""

from collections.abc import Sequence

import torch

from extrap_train.data.camera_check import is_degenerate
from extrap_train.data.pair_examples import Example, collate
from extrap_train.depth import require_depth
from extrap_train.errors import InputError
from extrap_train.geometry.viewpoints import references_by_nearness
from extrap_train.views import Camera, PairBatch, View, stack_cameras

_DEGENERATE = (
    "its camera is degenerate (NaN, no rotation, or a focal length that is not positive); correct "
    "the pose"
)


def query_batch(
    references: Sequence[View], queries: Camera, most_references: int, size: int
) -> tuple[PairBatch, list[tuple[int, ...]]]:
    """The batch of some queries (batched once), each with its nearest views as references.

    Views and cameras are cropped to centred squares of `size` pixels. The batch's `image`, the
    truth, is NaN; beside it, the indices of every query's references, nearest first. Raises
    InputError where a pose is degenerate or a view has no depth.
    """
    if not references:
        raise InputError("there is no view to start from; give at least one posed photograph")
    for view in references:
        if is_degenerate(view.camera):
            raise InputError(f"view {view.name}: {_DEGENERATE}")
    for index in is_degenerate(queries).nonzero().flatten().tolist():
        raise InputError(f"query {index}: {_DEGENERATE}")
    squares = [
        view if (view.camera.height, view.camera.width) == (size, size) else view.squared(size)
        for view in references
    ]
    cameras = stack_cameras([view.camera for view in squares])
    order = references_by_nearness(cameras, queries)[:, :most_references]
    images = torch.stack([view.image for view in squares])
    depths = torch.stack([require_depth(view) for view in squares])
    square_queries = queries.squared(size)
    unknown = torch.full((3, size, size), torch.nan)
    examples = [
        Example(unknown, square_queries[i], images[chosen], cameras[chosen], depths[chosen])
        for i, chosen in enumerate(torch.from_numpy(order))
    ]
    return collate(examples, most_references), [tuple(row) for row in order.tolist()]
