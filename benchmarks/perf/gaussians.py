"""Drawing Gaussians and differentiating the image, projection included; and a training step."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.perf.gaussians_reference import rasterize_reference
from benchmarks.perf.timing import Row, compare
from benchmarks.perf.warp import orbit_camera
from extrap_train.gaussians.losses import photograph, photometric_loss
from extrap_train.gaussians.rasterize import Backend, rasterizer

SIZES = (128, 256)
COUNTS = (10_000, 50_000)
SPACING_TO_SCALE = 0.55
"""Standard deviation of a Gaussian, in mean distances to the nearest neighbour."""
_MEAN_SPACING = 0.554
"""Mean distance to the nearest of random points whose density is 1."""
_REPEATS = 3
"""The reference takes seconds."""

Draw = Callable[..., Float[Tensor, "h w 3"]]


def run() -> list[Row]:
    """One row a number of Gaussians and an image size; with gsplat, too, where there is a GPU."""
    backends: list[Backend] = ["numba", "gsplat"] if torch.cuda.is_available() else ["numba"]
    rows = []
    for backend in backends:
        rows += [_compare(n, size, backend, _differentiate) for size in SIZES for n in COUNTS]
        rows.append(_compare(COUNTS[0], SIZES[0], backend, _train))
    return rows


def _compare(count: int, size: int, backend: Backend, job: Callable) -> Row:
    device = torch.device("cuda" if backend == "gsplat" else "cpu")
    camera = orbit_camera(0.0, size).to(device)
    rasterize = rasterizer(backend)

    def ours(*inputs: Tensor) -> Float[Tensor, "h w 3"]:
        poses = (camera.world_to_cam[None], camera.intrinsics[None])
        return rasterize(*inputs, *poses, size, size)[0][0]

    def reference(*inputs: Tensor) -> Float[Tensor, "h w 3"]:
        return rasterize_reference(camera, *inputs)

    mine, theirs = (
        job(draw, [x.to(device) for x in cube_of_gaussians(count)]) for draw in (ours, reference)
    )
    name = f"{count} Gaussians, {size}x{size}{', SSIM and Adam' if job is _train else ''}"
    return compare(name, device, mine, theirs, _REPEATS)


def _differentiate(draw: Draw, inputs: list[Tensor]) -> Callable[[], Float[Tensor, "h w 3"]]:
    """The squared difference of the image from grey, differentiated by all inputs."""
    leaves = [x.requires_grad_() for x in inputs]

    def once() -> Float[Tensor, "h w 3"]:
        image = draw(*leaves)
        torch.autograd.grad((image - 0.5).square().mean(), leaves)
        return image.detach()

    return once


def _train(draw: Draw, inputs: list[Tensor]) -> Callable[[], Float[Tensor, "h w 3"]]:
    """A step of 3DGS: drawing, 0.8 L1 + 0.2 (1 − SSIM), gradients, Adam."""
    means, quats, scales, opacities, colors = inputs
    free = [means, quats, scales.log(), opacities.logit(), colors]
    leaves = [x.requires_grad_() for x in free]
    grey = photograph(torch.full_like(draw(*inputs).detach().permute(2, 0, 1), 0.5))
    optimiser = torch.optim.Adam(leaves, lr=1e-3, fused=True)

    def once() -> Float[Tensor, "h w 3"]:
        image = draw(means, quats, leaves[2].exp(), leaves[3].sigmoid(), colors)
        optimiser.zero_grad()
        photometric_loss(image.permute(2, 0, 1), grey, 0.2, 0.8).backward()
        optimiser.step()
        return image.detach()

    return once


def cube_of_gaussians(count: int) -> list[Tensor]:
    """Means, quaternions, scales, opacities and colours, uniform in a cube of side 2."""
    g = torch.Generator().manual_seed(0)
    scale = SPACING_TO_SCALE * _MEAN_SPACING * (8 / count) ** (1 / 3)
    return [
        torch.rand(count, 3, generator=g) * 2 - 1,
        torch.randn(count, 4, generator=g),
        scale * (torch.rand(count, 3, generator=g) + 0.5),
        torch.randn(count, generator=g).sigmoid(),
        torch.rand(count, 3, generator=g),
    ]
