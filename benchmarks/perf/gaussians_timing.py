"""Drawing Gaussians and differentiating the image, projection included; and a training step."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.perf.timing import Timing, compare, devices
from benchmarks.perf.warp_timing import orbit_camera
from extrap_train.gaussians.density import rotation_matrices
from extrap_train.gaussians.differentiable import LOW_PASS, NEAR_PLANE
from extrap_train.gaussians.losses import photometric_loss, prepare_truth
from extrap_train.gaussians.projection_numba import MIN_ALPHA
from extrap_train.gaussians.rasterize import rasterizer
from extrap_train.geometry.cameras import pixel_grid
from extrap_train.views import Camera

SIZES = (128, 256)
COUNTS = (10_000, 50_000)
SPACING_TO_SCALE = 0.55
"""Standard deviation of a Gaussian, in mean distances to the nearest neighbour."""
_MEAN_SPACING = 0.554
"""Mean distance between nearest neighbours among random points of density 1."""
_REPEATS = 3
"""The reference takes seconds."""
TILE = 16
"""Faster here than 32, which took 1.6 to 3 times as long."""
_MAX_SIGMAS = 3.33
"""Beyond, even an opaque Gaussian covers less than MIN_ALPHA."""

DrawImage = Callable[..., Float[Tensor, "h w 3"]]


def run() -> list[Timing]:
    """One row per number of Gaussians and image size; where there is a GPU, gsplat's, too."""
    rows = []
    for device in devices():
        rows += [_compare(n, size, device, _differentiate) for size in SIZES for n in COUNTS]
        rows.append(_compare(COUNTS[0], SIZES[0], device, _train))
    return rows


def _compare(count: int, size: int, device: torch.device, job: Callable) -> Timing:
    camera = orbit_camera(0.0, size).to(device)
    rasterize = rasterizer("gsplat" if device.type == "cuda" else "numba")

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


def _differentiate(draw: DrawImage, inputs: list[Tensor]) -> Callable[[], Float[Tensor, "h w 3"]]:
    """The squared difference of the image from grey, differentiated by all inputs."""
    leaves = [x.requires_grad_() for x in inputs]

    def once() -> Float[Tensor, "h w 3"]:
        image = draw(*leaves)
        torch.autograd.grad((image - 0.5).square().mean(), leaves)
        return image.detach()

    return once


def _train(draw: DrawImage, inputs: list[Tensor]) -> Callable[[], Float[Tensor, "h w 3"]]:
    """A step of 3DGS: drawing, 0.8 L1 + 0.2 (1 − SSIM), gradients, Adam."""
    means, quats, scales, opacities, colors = inputs
    free = [means, quats, scales.log(), opacities.logit(), colors]
    leaves = [x.requires_grad_() for x in free]
    grey = prepare_truth(torch.full_like(draw(*inputs).detach().permute(2, 0, 1), 0.5))
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


def rasterize_reference(
    camera: Camera,
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    opacities: Float[Tensor, " n"],
    colors: Float[Tensor, "n d"],
) -> Float[Tensor, "h w d"]:
    """Plain torch: every tile a dense matrix of pixels by Gaussians, gradients by autograd.

    The image that `rasterization` draws, but that full pixels go on being blended."""
    x, y, z = (means @ camera.world_to_cam[:3, :3].mT + camera.world_to_cam[:3, 3]).unbind(-1)
    centers, covariances = _project(x, y, z, quats, scales, camera)
    radii = _MAX_SIGMAS * covariances.detach().diagonal(dim1=-2, dim2=-1).sqrt()
    low, high = centers.detach() - radii, centers.detach() + radii
    conics = torch.linalg.inv(covariances)
    grid = pixel_grid(camera.height, camera.width)
    order = torch.argsort(z)
    order = order[(z[order] >= NEAR_PLANE) & (opacities[order] >= MIN_ALPHA)]
    rows = []
    for top in range(0, camera.height, TILE):
        tiles = []
        for left in range(0, camera.width, TILE):
            corner = centers.new_tensor([left, top])
            touching = ((high[order] > corner) & (low[order] < corner + TILE)).all(1)
            i = order[touching]
            pixels = grid[top : top + TILE, left : left + TILE]
            tiles.append(_blend(pixels, centers[i], conics[i], opacities[i], colors[i]))
        rows.append(torch.cat(tiles, 1))
    return torch.cat(rows)


def _project(
    x: Float[Tensor, " n"],
    y: Float[Tensor, " n"],
    z: Float[Tensor, " n"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    camera: Camera,
) -> tuple[Float[Tensor, "n 2"], Float[Tensor, "n 2 2"]]:
    """Centres and covariances on the image plane."""
    k, zero = camera.intrinsics, torch.zeros_like(z)
    along_x = torch.stack([k[0, 0] / z, zero, -k[0, 0] * x / z**2], -1)
    along_y = torch.stack([zero, k[1, 1] / z, -k[1, 1] * y / z**2], -1)
    jacobian = torch.stack([along_x, along_y], 1) @ camera.world_to_cam[:3, :3]
    axes = jacobian @ (rotation_matrices(quats) * scales[:, None])
    covariances = axes @ axes.mT + LOW_PASS * torch.eye(2)
    return torch.stack([k[0, 0] * x / z + k[0, 2], k[1, 1] * y / z + k[1, 2]], -1), covariances


def _blend(
    pixels: Float[Tensor, "h w 2"],
    centers: Float[Tensor, "m 2"],
    conics: Float[Tensor, "m 2 2"],
    opacities: Float[Tensor, " m"],
    colors: Float[Tensor, "m d"],
) -> Float[Tensor, "h w d"]:
    """Blend sorted Gaussians, nearest first."""
    dx, dy = (pixels.reshape(-1, 1, 2) - centers).unbind(-1)
    a, b, c = conics[:, 0, 0], conics[:, 0, 1], conics[:, 1, 1]
    alpha = opacities * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
    alpha = torch.where(alpha >= MIN_ALPHA, alpha.clamp(max=0.999), 0)
    light = torch.cumprod(1 - alpha, 1)
    before = torch.cat([torch.ones_like(light[:, :1]), light[:, :-1]], 1)
    return ((alpha * before) @ colors).reshape(*pixels.shape[:2], -1)
