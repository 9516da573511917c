"""Drawing Gaussians and differentiating the image, projection included."""

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.methods.gaussians.rasterization import Backend, rasterizer
from benchmarks.perf.gaussians_reference import rasterize_reference
from benchmarks.perf.timing import Row, compare
from benchmarks.perf.warp import orbit_camera

SIZES = (128, 256)
COUNTS = (10_000, 50_000)
SPACING_TO_SCALE = 0.55
"""Standard deviation of a Gaussian, in mean distances to the nearest neighbour."""
_MEAN_SPACING = 0.554
"""Mean distance to the nearest of random points whose density is 1."""


def run() -> list[Row]:
    """One row a number of Gaussians and an image size; with gsplat, too, where there is a GPU."""
    backends: list[Backend] = ["numba", "gsplat"] if torch.cuda.is_available() else ["numba"]
    return [_compare(n, size, name) for name in backends for size in SIZES for n in COUNTS]


def _compare(count: int, size: int, backend: Backend) -> Row:
    device = torch.device("cuda" if backend == "gsplat" else "cpu")
    inputs = [x.to(device).requires_grad_() for x in cube_of_gaussians(count)]
    camera = orbit_camera(0.0, size).to(device)
    draw = rasterizer(backend)

    def ours() -> Float[Tensor, "h w 3"]:
        poses = (camera.world_to_cam[None], camera.intrinsics[None])
        return _differentiated(draw(*inputs, *poses, size, size)[0][0], inputs)

    def reference() -> Float[Tensor, "h w 3"]:
        return _differentiated(rasterize_reference(camera, *inputs), inputs)

    return compare(f"{count} Gaussians, {size}x{size}", device, ours, reference, repeats=7)


def _differentiated(image: Float[Tensor, "h w 3"], inputs: list[Tensor]) -> Float[Tensor, "h w 3"]:
    """The image, after its squared difference from grey has been differentiated by all inputs."""
    torch.autograd.grad((image - 0.5).square().mean(), inputs)
    return image.detach()


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
