"""A scene with exact answers as a method receives it, and the truth that it does not receive."""

import torch

from benchmarks.methods.base import SceneInputs
from extrap_train.depth.dataset import DatasetDepth
from extrap_train.views import View, stack_cameras
from tests.scenes import SPHERE_ON_PLANE, Scene, orbit_camera


def view_at(azimuth_deg: float, size: int, scene: Scene = SPHERE_ON_PLANE) -> View:
    camera = orbit_camera(azimuth_deg, size=size)
    return View(scene.image(camera), camera, scene.depth(camera), name=f"{azimuth_deg:g}")


def scene_inputs(
    inputs_deg: tuple[float, ...] = (0.0, 40.0, 80.0),
    targets_deg: tuple[float, ...] = (10.0, 60.0),
    size: int = 32,
) -> tuple[SceneInputs, torch.Tensor]:
    """What a method is told, and the images that it should make."""
    targets = [view_at(angle, size) for angle in targets_deg]
    inputs = SceneInputs(
        category="analytic",
        views=tuple(view_at(angle, size) for angle in inputs_deg),
        targets=stack_cameras([view.camera for view in targets]),
        depth_source=DatasetDepth(),
        seed=0,
    )
    return inputs, torch.stack([view.image for view in targets])
