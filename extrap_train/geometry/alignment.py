"""Depth of one new view against views that are known already, in closed form (paper
II-C).

Every edge, a pair of point maps in a frame and a unit of its own, is placed in the world by the
similarity that brings the known view's points to where they are known to lie; what the edge then
says of the new view is a depth for every pixel, and the new depth is a robust mean over the edges.
Nothing but the new view is estimated. The widths of all robust kernels come from the residuals, so
neither the scene's unit nor the source's noise has to be known.
"""

import math
from dataclasses import dataclass

import roma
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from extrap_train.geometry.cameras import pixel_grid, transform
from extrap_train.views import Camera

MAX_PAIRS = 4096
"""Point pairs, spread over the image, that an edge's similarity is fitted to."""
MAX_RANKED = 1024
"""Residuals, spread over the image, that a kernel's width is taken from."""
SIMILARITY_ROUNDS = 5
FUSION_ROUNDS = 3
MIN_PAIRS = 16
"""An edge with fewer usable pairs says nothing."""
WIDTH = 4.685
"""Width of Tukey's biweight in standard deviations: 95 % efficient on Gaussian noise."""
VECTOR_WIDTH = 1.5 * WIDTH
"""Width of the biweight for lengths of 3-D residuals, which are √3 standard deviations of a
coordinate on average (root mean square): 98 % efficient on Gaussian noise."""
_CHI3_MEDIAN = 1.538
"""Median length of a 3-D Gaussian vector, in standard deviations of a coordinate."""
_GAUSSIAN_MEDIAN = 0.6745
_FAR_WORSE = 3.0
_TIE = 1e-4
"""Relative difference of two distances below which rounding would decide between them."""
_MIN_SPREAD = 1e-5
"""Relative residuals below are rounding."""


@dataclass(frozen=True)
class Edges:
    """Point maps of a new view paired with known views; each edge in its own frame and unit."""

    new_points: Float[Tensor, "e h w 3"]
    new_confidence: Float[Tensor, "e h w"]
    """Not negative; 0 where the point means nothing."""
    known_points: Float[Tensor, "e n 3"]
    known_confidence: Float[Tensor, "e n"]
    world_points: Float[Tensor, "e n 3"]
    """Where the known view's points lie."""
    world_known: Bool[Tensor, "e n"]
    """False where the known view has no depth."""


@dataclass(frozen=True)
class Alignment:
    """The new view's depth, and how the edges agree on it."""

    depth: Float[Tensor, "h w"]
    """0 where no usable edge says anything."""
    confidence: Float[Tensor, "h w"]
    """The edges' mean confidence, times the share of them that agrees."""
    edge_to_world: Float[Tensor, "e 4 4"]
    """Similarities; meaningless for edges that are not `usable`."""
    spread: Float[Tensor, " e"]
    """Standard deviation of each edge's relative error on the known view, outliers aside."""
    usable: Bool[Tensor, " e"]


def align_view(camera: Camera, edges: Edges) -> Alignment:
    """Solve for the depth of the (unbatched) new view with everything known frozen.

    Each edge e has a similarity S_e = (s, R, t) from its frame to the world, fitted to the known
    view's points, and says the depth z_e(p) where S_e of its point is nearest to the ray of pixel
    p. The new depth is a robust mean of log z_e(p) over the edges.
    """
    pairs = _pairs(edges)
    usable = (pairs.weight > 0).sum(-1) >= MIN_PAIRS
    # min Σ w |S_e⁻¹ x_world − x_edge|², by weighted Procrustes.
    edge_to_world, spread = _similarities(pairs)
    usable &= torch.isfinite(edge_to_world).all(-1).all(-1)
    edge_to_world = torch.where(usable[:, None, None], edge_to_world, torch.eye(4).to(spread))
    # z_e(p) = r·x / r·r with the ray r = (x, y, 1) of pixel p.
    depths = _depths_along_rays(camera, camera.world_to_cam @ edge_to_world, edges.new_points)
    known = usable[:, None, None] & (depths > 0) & torch.isfinite(depths)
    # log z(p) = Σ w ρ log z_e / Σ w ρ, ρ Tukey's biweight of the edges' disagreement.
    confidence = torch.where(known, edges.new_confidence, 0)
    depth, agreement = _robust_mean(depths, confidence, _trust(spread, usable))
    count = (confidence > 0).sum(0)
    mean_confidence = confidence.sum(0) / count.clamp(min=1)
    return Alignment(depth, mean_confidence * agreement, edge_to_world, spread, usable)


@dataclass(frozen=True)
class _Pairs:
    """Coordinate by coordinate, as sums over points are fastest."""

    edge: Float[Tensor, "e 3 m"]
    world: Float[Tensor, "e 3 m"]
    weight: Float[Tensor, "e m"]


def _pairs(edges: Edges) -> _Pairs:
    """An even choice of the known views' points, weighted by what their confidence ranks."""
    stride = max(1, math.ceil(edges.known_points.shape[1] / MAX_PAIRS))
    edge, world = (
        points[:, ::stride].mT.contiguous() for points in (edges.known_points, edges.world_points)
    )
    finite = torch.isfinite(edge).all(1) & torch.isfinite(world).all(1)
    used = finite & edges.world_known[:, ::stride]
    weight = torch.where(used, _weight(edges.known_confidence[:, ::stride]), 0)
    edge, world = (torch.where(used[:, None], points, 0) for points in (edge, world))
    return _Pairs(edge, world, weight)


def _weight(confidence: Tensor) -> Tensor:
    """Compressed: networks' confidences grow without bound."""
    return torch.log1p(confidence.clamp(min=0))


def _similarities(pairs: _Pairs) -> tuple[Float[Tensor, "e 4 4"], Float[Tensor, " e"]]:
    """Robust weighted Procrustes by reweighting, and the spread of its relative residuals.

    Fitted from the world to the edge and inverted: noise is in the edge's points alone, and as
    regressors they would shrink the scale.
    """
    robust, extent = torch.ones_like(pairs.weight), _extent(pairs)[:, None]
    for step in range(SIMILARITY_ROUNDS):
        weight = (pairs.weight * robust).clamp(min=1e-12)
        rotation, shift, scale = _procrustes(pairs.world, pairs.edge, weight)
        fitted = (scale[:, None, None] * rotation) @ pairs.world + shift[..., None]
        residual = _length(fitted - pairs.edge)
        relative = residual / extent
        median = _strided_median(relative, pairs.weight > 0)
        sigma = (median / _CHI3_MEDIAN).clamp(min=_MIN_SPREAD)
        ratio = relative / sigma[:, None]
        # A convex kernel finds the basin, a redescending one forgets what lies outside of it.
        redescending = step >= SIMILARITY_ROUNDS // 2
        robust = _biweight(ratio / VECTOR_WIDTH) if redescending else 1 / (1 + ratio)
    inverse_scale = 1 / scale
    linear = inverse_scale[:, None, None] * rotation.mT
    matrix = torch.eye(4).to(linear).repeat(len(linear), 1, 1)
    matrix[:, :3, :3] = linear
    matrix[:, :3, 3] = -(linear @ shift[..., None])[..., 0]
    return matrix, sigma


def _procrustes(
    source: Float[Tensor, "e 3 m"], target: Float[Tensor, "e 3 m"], weight: Float[Tensor, "e m"]
) -> tuple[Float[Tensor, "e 3 3"], Float[Tensor, "e 3"], Float[Tensor, " e"]]:
    """The rotation, shift and scale of the weighted least squares (Umeyama 1991).

    roma's own registration is made for many small problems; a few large ones take it three times
    as long.
    """
    share = (weight / weight.sum(-1, keepdim=True))[:, None]
    source_middle, target_middle = source @ share.mT, target @ share.mT
    source, target = source - source_middle, (target - target_middle) * share
    rotation, singular = roma.special_procrustes(target @ source.mT, return_singular_values=True)
    scale = singular.sum(-1) / (source.square() @ share.mT).sum((-1, -2)).clamp(min=1e-30)
    shift = target_middle - scale[:, None, None] * (rotation @ source_middle)
    return rotation, shift[..., 0], scale


def _trust(spread: Float[Tensor, " e"], usable: Bool[Tensor, " e"]) -> Float[Tensor, " e"]:
    """Weight of each edge: less if it fits far worse than most do, no more if it fits better.

    A good fit to the known view proves nothing: smooth errors vanish in it and stay in the new one.
    """
    median = _strided_median(spread[None], usable[None])
    return 1 / (1 + (spread / (_FAR_WORSE * median.clamp(min=_MIN_SPREAD))).square())


def _extent(pairs: _Pairs) -> Float[Tensor, " e"]:
    """Mean distance of each edge's points from their middle, in the edge's unit."""
    used = (pairs.weight > 0).to(pairs.edge)[..., None]
    share = used / used.sum(1, keepdim=True).clamp(min=1)
    away = _length(pairs.edge - pairs.edge @ share)
    return (away[:, None] @ share)[:, 0, 0].clamp(min=1e-30)


def _length(vectors: Float[Tensor, "e 3 m"]) -> Float[Tensor, "e m"]:
    """Fifty times faster than a norm along any but the last dimension, on the CPU."""
    return vectors.square().sum(1).sqrt()


def _depths_along_rays(
    camera: Camera, edge_to_cam: Float[Tensor, "e 4 4"], points: Float[Tensor, "e h w 3"]
) -> Float[Tensor, "e h w"]:
    """The depth whose point on each pixel's ray is nearest to the edge's point."""
    grid = pixel_grid(camera.height, camera.width, points.device).to(points.dtype)
    k = camera.intrinsics
    x, y = (grid[..., 0] - k[0, 2]) / k[0, 0], (grid[..., 1] - k[1, 2]) / k[1, 1]
    in_cam = transform(edge_to_cam, points.flatten(1, 2)).view_as(points)
    along = in_cam[..., 0] * x + in_cam[..., 1] * y + in_cam[..., 2]
    return along / (x.square() + y.square() + 1)


def _robust_mean(
    depths: Float[Tensor, "e h w"], confidence: Float[Tensor, "e h w"], trust: Float[Tensor, " e"]
) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
    """Redescending mean of log depth over the edges, and the share of confidence that agrees."""
    known = confidence > 0
    log = torch.where(known, depths, 1).log()
    weight = _weight(confidence)
    center = _weighted_median(log, weight)
    reliable = weight * trust[:, None, None]
    robust = known.to(log.dtype)
    for _ in range(FUSION_ROUNDS):
        residual = (log - center).abs()
        several = known & (known.sum(0) > 1)
        sigma = _strided_median(residual.flatten()[None], several.flatten()[None])
        sigma = (sigma / _GAUSSIAN_MEDIAN).clamp(min=_MIN_SPREAD)
        robust = _biweight(residual / (WIDTH * sigma)) * known
        total = (reliable * robust).sum(0)
        mean = (reliable * robust * log).sum(0) / total.clamp(min=1e-30)
        center = torch.where(total > 0, mean, center)
    agreement = (weight * robust).sum(0) / weight.sum(0).clamp(min=1e-30)
    return torch.where(known.any(0), center.exp(), 0), agreement


def _biweight(ratio: Tensor) -> Tensor:
    """Tukey's weight: 1 at 0, falling to 0 at 1 and beyond."""
    return (1 - ratio.square()).clamp(min=0).square()


def _weighted_median(values: Float[Tensor, "e h w"], weight: Float[Tensor, "e h w"]) -> Tensor:
    """Median along the first dimension: the value with the least weighted distance from all.

    Ties are averaged, as rounding would decide them otherwise; where no weight is positive it
    means nothing.
    """
    distance = torch.stack([((values - one).abs() * weight).sum(0) for one in values])
    distance = torch.where(weight > 0, distance, torch.inf)
    least = distance <= distance.amin(0) * (1 + _TIE)
    return (values * least).sum(0) / least.sum(0)


def _strided_median(values: Float[Tensor, "e n"], mask: Bool[Tensor, "e n"]) -> Float[Tensor, " e"]:
    """The lower median of each row's masked entries; 0 without any.

    Of longer rows every n-th entry is ranked, `MAX_RANKED` to twice as many.
    """
    stride = max(1, values.shape[1] // MAX_RANKED)
    chosen = torch.where(mask[:, ::stride], values[:, ::stride], torch.nan)
    return chosen.nanmedian(-1).values.nan_to_num()
