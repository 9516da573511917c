"""One camera's picture of Gaussians, from whichever rasteriser."""

from dataclasses import dataclass

from jaxtyping import Float, Int
from torch import Tensor

from extrap_train.gaussians.gaussians import Gaussians
from extrap_train.gaussians.rasterization import Rasterization
from extrap_train.views import Camera


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
