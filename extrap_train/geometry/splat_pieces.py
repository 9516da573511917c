"""What is cut into points, what comes out, and how finely: the same for every implementation."""

from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor

from extrap_train.geometry.normals import Surface
from extrap_train.geometry.screen_points import ScreenPoints
from extrap_train.views import Camera

LARGEST_SPACING = 1.05
"""Query pixels between neighbouring points of a surface: every pixel centre then lies well inside
a footprint."""
REACH_MARGIN = 0.03
"""Query pixels by which neighbouring pieces of surface overlap, so that no seam shows what is
behind."""
MOST_POINTS = 8
"""Points per reference pixel along each axis: a surface stretched further is torn, it was hardly
seen."""


@dataclass(frozen=True)
class Pieces:
    """References as pieces of surface, one a pixel, and the query that they are drawn for."""

    surface: Surface
    drawn: Bool[Tensor, "b k h w"]
    """Which pixels lie on a surface that faces the query."""
    matrix: Float[Tensor, "b k 3 4"]
    """From (u, v, 1, 1/z) of a reference to the query's homogeneous pixel, times z_query/z."""
    cameras: Camera
    query: Camera


@dataclass(frozen=True)
class Samples:
    """Points of the references' surfaces that face the query camera, with interpolated values."""

    points: ScreenPoints
    values: Float[Tensor, "n c"]
