"""Points of the warp moved by smooth flows, before they are drawn."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from extrap_train.geometry.flow import dense_flow
from extrap_train.geometry.splat_torch import ScreenPoints
from extrap_train.views import Camera


def moved_points(
    points: ScreenPoints,
    reference: Int[Tensor, " n"],
    flows: Float[Tensor, "b k 2 g g"],
    query: Camera,
) -> ScreenPoints:
    """The points where their reference's flow takes them; differentiable."""
    u, v = points.u.clone(), points.v.clone()
    for index, flow in enumerate(flows.flatten(0, 1)):
        own = (reference == index).nonzero()[:, 0]
        step = _steps(flow, torch.stack([points.u[own], points.v[own]]), query)
        u, v = u.index_add(0, own, step[0]), v.index_add(0, own, step[1])
    return replace(points, u=u, v=v)


def move_points_numba(
    points: Float[np.ndarray, "3 n"],
    spans: Int[np.ndarray, "b m 2"],
    flows: Float[Tensor, "b k 2 g g"],
    query: Camera,
) -> None:
    """The same, in place, for points that lie one reference after the other (`splat_numba`)."""
    references = flows.flatten(0, 1)
    own_spans = spans.reshape(len(references), -1, 2)
    for flow, own in zip(references, own_spans, strict=True):
        if not flow.any():
            continue
        for first, last in own:
            part = points[:2, first:last]
            part += _steps(flow, torch.from_numpy(part), query).numpy()


def _steps(
    flow: Float[Tensor, "2 g g"], pixels: Float[Tensor, "2 n"], query: Camera
) -> Float[Tensor, "2 n"]:
    """The flow at (u, v), in pixels: interpolated between pixel centres, which a smooth field
    bears, and which is much cheaper than its splines at every point."""
    field = dense_flow(flow, query.height, query.width)
    size = pixels.new_tensor([query.width, query.height])
    at = (pixels.mT / size * 2 - 1)[None, None]
    found = functional.grid_sample(
        field[None].to(pixels), at, padding_mode="border", align_corners=False
    )
    return found[0, :, 0] * (size / 2)[:, None]
