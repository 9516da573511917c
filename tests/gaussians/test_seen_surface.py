"""The points that a Gaussian method is scored by: what its Gaussians hide together."""

import torch

from extrap_train.gaussians.fit import Fit
from extrap_train.gaussians.gaussian_options import GaussianOptions
from extrap_train.gaussians.init import Points, parameters_from_points
from extrap_train.gaussians.recipe import Recipe
from extrap_train.gaussians.training_scene import training_scene
from tests.benchmarks.analytic import scene_inputs

SIDE = 40


def _wall(opacity: float) -> tuple[Fit, torch.Tensor, torch.Tensor]:
    """Gaussians on a square around the scene's centre that faces the first camera; its centre and
    normal in the world."""
    inputs, _ = scene_inputs(size=24)
    recipe = Recipe(GaussianOptions(), training_scene(inputs.views, inputs.depth_source, seed=0))
    across, down, ahead = recipe.cameras[0].world_to_cam[:3, :3]
    steps = torch.linspace(-0.4, 0.4, SIDE)
    grid = steps[:, None, None] * across + steps[None, :, None] * down
    positions = grid.reshape(-1, 3)
    points = Points(positions, torch.full_like(positions, 0.5), torch.ones(len(positions)))
    parameters = parameters_from_points(points, 0, opacity, torch.full((len(positions),), 0.02))
    return Fit(parameters, recipe), recipe.scene.frame.center, ahead


def test_faint_gaussians_are_a_surface_where_they_hide_together() -> None:
    fit, center, normal = _wall(opacity=0.2)
    points = fit.seen_surface()
    assert len(points) > 100
    off = (points - center) @ normal / fit.recipe.scene.frame.unit
    straight_ahead = off[:100]  # Aside, a pixel shares Gaussians whose depths differ.
    assert straight_ahead.abs().max() < 1e-5
    assert off.abs().max() < 0.1
    aside = (points - center).norm(dim=-1) / fit.recipe.scene.frame.unit
    assert aside.max() < 0.4 * 2**0.5 + 0.05


def test_what_shines_through_is_no_surface() -> None:
    fit, _, _ = _wall(opacity=0.005)
    assert fit.seen_surface().shape == (0, 3)
