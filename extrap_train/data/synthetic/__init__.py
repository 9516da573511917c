"""Six categories of textured objects in lit surroundings, with exact depth. The world's +Z is up.

`build_scene` draws a scene, `handheld_orbit` a walk around it, `render` a photograph,
`surface_points` the ground-truth cloud. Everything follows from (category, index, seed) alone.
"""

from extrap_train.data.synthetic.capture import handheld_orbit, sequence_name, walk_seed
from extrap_train.data.synthetic.categories import build_scene
from extrap_train.data.synthetic.parts import SyntheticScene
from extrap_train.data.synthetic.render import (
    DENSE_POINTS,
    SurfacePoints,
    render,
    surface_points,
    trace,
)

__all__ = [
    "DENSE_POINTS",
    "SurfacePoints",
    "SyntheticScene",
    "build_scene",
    "handheld_orbit",
    "render",
    "sequence_name",
    "surface_points",
    "trace",
    "walk_seed",
]
