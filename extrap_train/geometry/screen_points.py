"""What defines the splat, the same for every implementation."""

from dataclasses import dataclass, replace

from jaxtyping import Float, Int
from torch import Tensor

DEPTH_SHARPNESS = 200.0
"""β: a surface 5 % behind the nearest one weighs e⁻¹⁰, so it does not bleed through."""

OUTSIDE = -10.0
"""Pixel coordinate of points that are not to be drawn."""


@dataclass(frozen=True)
class ScreenPoints:
    """Points seen by cameras of one image size: `image` says by which, in ascending order."""

    u: Float[Tensor, "n"]
    v: Float[Tensor, "n"]
    depth: Float[Tensor, "n"]
    """Positive."""
    reach_u: Float[Tensor, "n"]
    """Half the width, in pixels up to 1, of the piece of surface that the point stands for."""
    reach_v: Float[Tensor, "n"]
    image: Int[Tensor, "n"]

    def __getitem__(self, chosen: Int[Tensor, "m"]) -> "ScreenPoints":
        """The points with these indices."""
        return replace(self, **{name: column[chosen] for name, column in vars(self).items()})
