"""Category diffusion models that complete 3D scenes from a few posed photos.

The names below are the public Python interface: they stay, and everything else may change.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from benchmarks.methods.base import Stopwatch, Synthesis
    from extrap_train.api import (
        complete_scene,
        fit_gaussians,
        open_generator,
        open_views,
        score_method,
        warp_view,
    )
    from extrap_train.config import StereoConfig
    from extrap_train.data.scene_spec import open_scene
    from extrap_train.errors import InputError
    from extrap_train.figures import save_picture
    from extrap_train.gaussians.ply import write_splats
    from extrap_train.tasks.view import walk_around
    from extrap_train.views import Camera, View, Warp, stack_cameras

_MODULES = {
    "extrap_train.api": (
        "complete_scene", "fit_gaussians", "open_generator", "open_views", "score_method",
        "warp_view",
    ),
    "extrap_train.data.scene_spec": ("open_scene",),
    "extrap_train.tasks.view": ("walk_around",),
    "extrap_train.views": ("Camera", "View", "Warp", "stack_cameras"),
    "extrap_train.config": ("StereoConfig",),
    "extrap_train.errors": ("InputError",),
    "extrap_train.gaussians.ply": ("write_splats",),
    "extrap_train.figures": ("save_picture",),
    "benchmarks.methods.base": ("Stopwatch", "Synthesis"),
}  # fmt: skip
_HOMES = {name: module for module, names in _MODULES.items() for name in names}
"""Where each name is defined: it is imported when it is asked for, so that `--help` stays fast."""

__all__ = [
    "Camera",
    "InputError",
    "StereoConfig",
    "Stopwatch",
    "Synthesis",
    "View",
    "Warp",
    "complete_scene",
    "fit_gaussians",
    "open_generator",
    "open_scene",
    "open_views",
    "save_picture",
    "score_method",
    "stack_cameras",
    "walk_around",
    "warp_view",
    "write_splats",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)
