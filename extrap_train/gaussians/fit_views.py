"""Gaussians of a capture, in one call."""

from collections.abc import Sequence

from extrap_train.depth import DepthSource
from extrap_train.gaussians.options import GaussianOptions
from extrap_train.gaussians.recipe import Recipe
from extrap_train.gaussians.scene import training_scene
from extrap_train.gaussians.trainer import Fit, fit
from extrap_train.views import View


def fit_views(
    views: Sequence[View], depth_source: DepthSource, options: GaussianOptions, seed: int
) -> Fit:
    """Plain 3DGS of posed views, with a progress bar; `Fit.gaussians()` is what a PLY holds.

    `options.init="dense"` starts from the depth source's points, which is best where views carry
    depth. InputError for views or points that cannot be used, `Diverged` where training fails.
    """
    return fit(Recipe(options, training_scene(views, depth_source, seed)), show_progress=True)
