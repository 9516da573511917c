"""Drawing Gaussians, with gsplat's `rasterization` signature and results."""

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import torch
from jaxtyping import Float, Int
from numba.core.event import Event, Listener, install_listener
from torch import Tensor

from extrap_train.errors import InputError
from extrap_train.gaussians.differentiable import (
    LOW_PASS,
    NEAR_PLANE,
    Ellipses,
    blend_ellipses,
    project,
)
from extrap_train.gaussians.gaussian_model import Gaussians, sh_colors
from extrap_train.views import Camera

_LOG = logging.getLogger(__name__)


class _Announcer(Listener):
    """Logs one line when numba compiles for the first time, none when it loads from its cache."""

    def __init__(self) -> None:
        self.silent = False

    def on_start(self, event: Event) -> None:
        if not self.silent:
            _LOG.warning(
                "compiling the CPU rasteriser (about half a minute, once on this machine; "
                "later runs load it from numba's cache)"
            )
        self.silent = True

    def on_end(self, event: Event) -> None:
        """Nothing to say."""


_ANNOUNCER = _Announcer()


@contextmanager
def announce_compilation() -> Iterator[None]:
    """Log a warning, once a process, if numba compiles anything inside."""
    with install_listener("numba:compile", _ANNOUNCER):
        yield


RenderMode = Literal["RGB", "D", "ED", "RGB+D", "RGB+ED"]
_MIN_DIVISOR = 1e-10

Rasterization = Callable[..., tuple[Tensor, Tensor, dict[str, Any]]]
"""The signature of `rasterization` below, which is the common part of gsplat's."""


def rasterizer(name: str) -> Rasterization:
    """The drawing function of that name: `numba` on the CPU, `gsplat` on CUDA."""
    if name == "numba":
        return rasterization
    try:
        from gsplat import rasterization as on_cuda
    except ImportError as error:
        raise InputError(
            f"rasterizer=gsplat needs the package gsplat ({error}): "
            'pip install "extrap-train[gpu]", or rasterizer=numba'
        ) from error
    if not torch.cuda.is_available():
        raise InputError("rasterizer=gsplat needs a CUDA device; use rasterizer=numba")
    return partial(on_cuda, packed=False)


@announce_compilation()
def rasterization(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    opacities: Float[Tensor, " n"],
    colors: Float[Tensor, "n d"] | Float[Tensor, "n k 3"] | Float[Tensor, "c n d"],
    viewmats: Float[Tensor, "c 4 4"],
    Ks: Float[Tensor, "c 3 3"],
    width: int,
    height: int,
    near_plane: float = NEAR_PLANE,
    eps2d: float = LOW_PASS,
    sh_degree: int | None = None,
    backgrounds: Float[Tensor, "c d"] | None = None,
    render_mode: RenderMode = "RGB",
) -> tuple[Float[Tensor, "c h w x"], Float[Tensor, "c h w 1"], dict[str, Any]]:
    """Draw `n` Gaussians as `c` cameras see them: colours, alphas, and what was found on the way.

    `colors` are d channels a Gaussian (or a Gaussian and camera), or spherical-harmonic
    coefficients where `sh_degree` says how many bands of them to use. `render_mode`: colours,
    accumulated depth (D) or expected depth (ED, 0 where nothing is), or colours with one of them
    as the last channel. `backgrounds` shine through the colours, not through the depth.
    `viewmats` are `world_to_cam`; quaternions are (w, x, y, z) of any length. Gradients flow to
    everything but `Ks`. The third result has `means2d` (c n 2, in px; ask it to retain its
    gradient, which is what densification wants), `radii` (c n 2, whole px, 0 where not drawn),
    `depths` (c n), `width`, `height` and `n_cameras`.
    """
    cameras = [Camera(*pose, height, width) for pose in zip(viewmats, Ks, strict=True)]
    shape = (means, quats, scales, opacities)
    views = [project(*shape, camera, near_plane, eps2d) for camera in cameras]
    means2d = torch.stack([view.means for view in views])
    drawn = [
        _draw(
            replace(view, means=means2d[c]),
            opacities,
            _colors(colors, means, camera, sh_degree, c),
            None if backgrounds is None else backgrounds[c],
            render_mode,
            (height, width),
        )
        for c, (view, camera) in enumerate(zip(views, cameras, strict=True))
    ]
    found = {
        "means2d": means2d,
        "radii": torch.stack([view.radii for view in views]).int(),
        "depths": torch.stack([view.depths for view in views]),
        "width": width,
        "height": height,
        "n_cameras": len(cameras),
    }
    images, alphas = (torch.stack(side) for side in zip(*drawn, strict=True))
    return images, alphas[..., None], found


def _colors(
    colors: Tensor, means: Float[Tensor, "n 3"], camera: Camera, sh_degree: int | None, index: int
) -> Float[Tensor, "n d"]:
    """What each Gaussian looks like from the camera with that index."""
    if sh_degree is None:
        return colors[index] if colors.dim() == 3 else colors
    return sh_colors(colors, means, torch.inverse(camera.world_to_cam)[:3, 3], sh_degree)


def _draw(
    ellipses: Ellipses,
    opacities: Float[Tensor, " n"],
    colors: Float[Tensor, "n d"],
    background: Float[Tensor, " d"] | None,
    mode: RenderMode,
    size: tuple[int, int],
) -> tuple[Float[Tensor, "h w x"], Float[Tensor, "h w"]]:
    """One camera's image, with the channels that the mode asks for, and its alpha."""
    depth = ellipses.depths[:, None]
    if background is None:
        background = colors.new_zeros(colors.shape[1])
    if mode != "RGB":
        with_colors = mode.startswith("RGB")
        colors = torch.cat([colors, depth], 1) if with_colors else depth
        behind = background if with_colors else background[:0]
        background = torch.cat([behind, behind.new_zeros(1)])
    image, transmittance = blend_ellipses(ellipses, opacities, colors, background, *size)
    alpha = 1 - transmittance
    if mode.endswith("ED"):
        expected = image[..., -1:] / alpha[..., None].clamp(min=_MIN_DIVISOR)
        image = torch.cat([image[..., :-1], expected], -1)
    return image, alpha


@dataclass(frozen=True)
class Drawing:
    """What one camera sees."""

    image: Float[Tensor, "3 h w"]
    depth: Float[Tensor, "h w"]
    """Expected depth; 0 where nothing is."""
    alpha: Float[Tensor, "h w"]
    centers: Float[Tensor, "1 n 2"]
    """Projected means in pixels: holds the screen-space gradient after a backward pass."""
    radii: Int[Tensor, "1 n 2"]
    """In pixels; 0 where a Gaussian is not drawn."""


def draw(
    rasterize: Rasterization,
    gaussians: Gaussians,
    camera: Camera,
    background: float,
    sh_degree: int,
    colors: Float[Tensor, "n 3"] | None = None,
) -> Drawing:
    """Colours by spherical harmonics up to `sh_degree`, or as given."""
    behind = gaussians.means.new_full((1, 3), background)
    values, alphas, found = rasterize(
        means=gaussians.means,
        quats=gaussians.quats,
        scales=gaussians.scales,
        opacities=gaussians.opacities,
        colors=gaussians.sh if colors is None else colors,
        viewmats=camera.world_to_cam[None],
        Ks=camera.intrinsics[None],
        width=camera.width,
        height=camera.height,
        sh_degree=sh_degree if colors is None else None,
        backgrounds=behind,
        render_mode="RGB+ED",
    )
    centers = found["means2d"]
    if centers.requires_grad:
        centers.retain_grad()
    image = values[0, ..., :3].permute(2, 0, 1)
    return Drawing(image, values[0, ..., 3], alphas[0, ..., 0], centers, found["radii"])
