"""Aligning one new view to six known ones: closed form against gradient descent, on four kinds of
point maps.
"""

from collections.abc import Callable

import roma
import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.perf.timing import Timing, compare
from benchmarks.perf.warp_timing import bumpy_depth, orbit_camera
from extrap_train.geometry.alignment import Edges, align_view
from extrap_train.geometry.cameras import transform, unproject_to_world
from extrap_train.views import Camera

SIZE = 128
KNOWN_ANGLES_DEG = (-50.0, -30.0, -15.0, 15.0, 30.0, 50.0)
REPEATS = 2
STEPS = 300
LEARNING_RATE = 0.01
"""Adam's steps and learning rate in the reference."""

Noise = Callable[[Float[Tensor, "h w"], torch.Generator], Float[Tensor, "h w"]]
"""A depth map and what a source would make of it."""


def clean(depth: Float[Tensor, "h w"], generator: torch.Generator) -> Float[Tensor, "h w"]:
    """The depth without noise."""
    return depth


def noisy(depth: Float[Tensor, "h w"], generator: torch.Generator) -> Float[Tensor, "h w"]:
    """1 % Gaussian noise in every pixel."""
    return depth * (1 + 0.01 * torch.randn(depth.shape, generator=generator))


def bent(depth: Float[Tensor, "h w"], generator: torch.Generator) -> Float[Tensor, "h w"]:
    """A smooth error of up to 3 %, as networks make."""
    v, u = torch.meshgrid(*(torch.linspace(0, 1, n) for n in depth.shape), indexing="ij")
    a, b, phase = torch.rand(3, generator=generator)
    return depth * (1 + 0.03 * torch.sin(6 * (a - 0.5) * u + 6 * (b - 0.5) * v + 6.3 * phase))


def with_outliers(depth: Float[Tensor, "h w"], generator: torch.Generator) -> Float[Tensor, "h w"]:
    """1 % noise, and every fifth pixel anywhere between half and twice its depth."""
    wild = torch.rand(depth.shape, generator=generator) < 0.2
    factor = 0.5 * 4 ** torch.rand(depth.shape, generator=generator)
    return torch.where(wild, depth * factor, noisy(depth, generator))


NOISES: dict[str, Noise] = {
    "clean": clean,
    "noisy 1%": noisy,
    "bent 3%": bent,
    "outliers 20%": with_outliers,
}


def run() -> list[Timing]:
    """One row per kind of noise; the case names both mean relative depth errors."""
    return [_compare(name, noise) for name, noise in NOISES.items()]


def _compare(name: str, noise: Noise) -> Timing:
    camera, depth, edges = bumpy_edges(SIZE, noise)

    def ours() -> Float[Tensor, "h w"]:
        return align_view(camera, edges).depth

    def reference() -> Float[Tensor, "h w"]:
        return align_by_descent(camera, edges)

    errors = [relative_error(solve(), depth) for solve in (ours, reference)]
    case = "{}, {} edges, {}x{}, error {:.5f} / {:.5f}".format(
        name, len(edges.new_points), SIZE, SIZE, *errors
    )
    return compare(case, torch.device("cpu"), ours, reference, REPEATS)


def relative_error(estimate: Float[Tensor, "h w"], truth: Float[Tensor, "h w"]) -> float:
    """Mean of |estimate / truth − 1|."""
    return float((estimate / truth - 1).abs().mean())


def bumpy_edges(size: int, noise: Noise) -> tuple[Camera, Float[Tensor, "h w"], Edges]:
    """A new view of a bumpy ball, its true depth, and its edges to the known views.

    Every edge is in a random frame and unit; both of its point maps are as noisy.
    """
    generator = torch.Generator().manual_seed(0)
    camera = orbit_camera(0.0, size)
    depth = bumpy_depth(size)
    others = [orbit_camera(angle, size) for angle in KNOWN_ANGLES_DEG]
    maps = torch.stack([_edge(depth, (camera, other), noise, generator) for other in others])
    known = maps[:, 1].flatten(1, 2)
    return (
        camera,
        depth,
        Edges(
            new_points=maps[:, 0],
            new_confidence=torch.ones(maps[:, 0].shape[:-1]),
            known_points=known,
            known_confidence=torch.ones(known.shape[:-1]),
            world_points=torch.stack([unproject_to_world(depth, c).flatten(0, 1) for c in others]),
            world_known=torch.ones(known.shape[:-1], dtype=torch.bool),
        ),
    )


def _edge(
    depth: Float[Tensor, "h w"],
    cameras: tuple[Camera, Camera],
    noise: Noise,
    generator: torch.Generator,
) -> Float[Tensor, "2 h w 3"]:
    """Both cameras' noisy points, moved together by a random similarity."""
    scale = float(0.5 + torch.rand((), generator=generator))
    rotation = roma.rotvec_to_rotmat(torch.randn(3, generator=generator))
    shift = torch.randn(3, generator=generator)
    points = [unproject_to_world(noise(depth, generator), camera) for camera in cameras]
    return scale * torch.stack(points) @ rotation.mT + shift


def align_by_descent(camera: Camera, edges: Edges, steps: int = STEPS) -> Float[Tensor, "h w"]:
    """Gradient descent over the graph, as pairwise 3-D models are usually aligned.

    Poses and known depths are frozen; Adam minimises the confidence-weighted distances of both
    views' points to where they belong, over the edges' similarities and the new depth. Starts from
    each edge's plain weighted Procrustes and the first edge's depth; cosine schedule.
    """
    known_weight = edges.known_confidence.log1p() * edges.world_known
    new_weight = edges.new_confidence.log1p()
    rotation, shift, scale = roma.rigid_points_registration(
        edges.known_points, edges.world_points, weights=known_weight, compute_scaling=True
    )
    first = transform(camera.world_to_cam, _moved(rotation, shift, scale, edges.new_points[:1])[0])
    log_depth = first[..., 2].clamp(min=1e-3).log().requires_grad_()
    quaternion = roma.rotmat_to_unitquat(rotation).requires_grad_()
    shift, log_scale = shift.requires_grad_(), scale.log().requires_grad_()
    parameters = [log_depth, quaternion, shift, log_scale]
    optimizer = torch.optim.Adam(parameters, lr=LEARNING_RATE, betas=(0.9, 0.9))
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for _ in range(steps):
        optimizer.zero_grad()
        unit = quaternion / quaternion.norm(dim=-1, keepdim=True)
        pose = (roma.unitquat_to_rotmat(unit), shift, log_scale.exp())
        new_world = unproject_to_world(log_depth.exp(), camera)
        new_error = (_moved(*pose, edges.new_points) - new_world).norm(dim=-1)
        known_error = (_moved(*pose, edges.known_points) - edges.world_points).norm(dim=-1)
        loss = (new_error * new_weight).mean() + (known_error * known_weight).mean()
        loss.backward()
        optimizer.step()
        schedule.step()
    return log_depth.detach().exp()


def _moved(rotation: Tensor, shift: Tensor, scale: Tensor, points: Tensor) -> Tensor:
    """The first of the points' edges, or all of them, in the world."""
    flat = points.flatten(1, -2)
    count = len(flat)
    turned = flat @ rotation[:count].mT
    return (scale[:count, None, None] * turned + shift[:count, None]).view_as(points)
