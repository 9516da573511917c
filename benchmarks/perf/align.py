"""Aligning one new view to six known ones: closed form against gradient descent, on four kinds of
point maps.
"""

from collections.abc import Callable

import roma
import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.perf.align_reference import align_by_descent
from benchmarks.perf.timing import Row, compare
from benchmarks.perf.warp import bumpy_depth, orbit_camera
from extrap_train.geometry.alignment import Edges, align_view
from extrap_train.geometry.cameras import unproject_to_world
from extrap_train.views import Camera

SIZE = 128
KNOWN_ANGLES_DEG = (-50.0, -30.0, -15.0, 15.0, 30.0, 50.0)
REPEATS = 2

Noise = Callable[[Float[Tensor, "h w"], torch.Generator], Float[Tensor, "h w"]]
"""A depth map and what a source would make of it."""


def clean(depth: Float[Tensor, "h w"], generator: torch.Generator) -> Float[Tensor, "h w"]:
    """As it is."""
    return depth


def noisy(depth: Float[Tensor, "h w"], generator: torch.Generator) -> Float[Tensor, "h w"]:
    """1 % Gaussian noise in every pixel."""
    return depth * (1 + 0.01 * torch.randn(depth.shape, generator=generator))


def bent(depth: Float[Tensor, "h w"], generator: torch.Generator) -> Float[Tensor, "h w"]:
    """A smooth error of up to 3 %, as networks make."""
    v, u = torch.meshgrid(*(torch.linspace(0, 1, n) for n in depth.shape), indexing="ij")
    a, b, phase = torch.rand(3, generator=generator)
    return depth * (1 + 0.03 * torch.sin(6 * (a - 0.5) * u + 6 * (b - 0.5) * v + 6.3 * phase))


def ridden(depth: Float[Tensor, "h w"], generator: torch.Generator) -> Float[Tensor, "h w"]:
    """1 % noise, and every fifth pixel anywhere between half and twice its depth."""
    wild = torch.rand(depth.shape, generator=generator) < 0.2
    factor = 0.5 * 4 ** torch.rand(depth.shape, generator=generator)
    return torch.where(wild, depth * factor, noisy(depth, generator))


NOISES: dict[str, Noise] = {
    "clean": clean,
    "noisy 1%": noisy,
    "bent 3%": bent,
    "outliers 20%": ridden,
}


def run() -> list[Row]:
    """One row a kind of noise; the case names both mean relative depth errors."""
    return [_compare(name, noise) for name, noise in NOISES.items()]


def _compare(name: str, noise: Noise) -> Row:
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
