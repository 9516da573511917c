"""A scene with exact answers as a method receives it, and the truth that it does not receive."""

from dataclasses import dataclass, replace

import torch

from benchmarks.methods.base import SceneInputs
from extrap_train.data.sequences import Frame, FrameSequence
from extrap_train.depth import DatasetDepth
from extrap_train.views import View, stack_cameras
from tests.scenes import Hit, Scene, orbit_camera, sphere


def _from_inside(radius: float) -> Hit:
    """A ball's inner surface."""

    def hit(origins: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
        a, b = directions.square().sum(1), (origins * directions).sum(1)
        return (-b + (b.square() - a * (origins.square().sum(1) - radius**2)).sqrt()) / a

    return hit


BALL = Scene((sphere(0.6), _from_inside(4.0)))
"""A ball in a round room: seen from all around."""


def view_at(azimuth_deg: float, size: int) -> View:
    camera = orbit_camera(azimuth_deg, size=size)
    return View(BALL.image(camera), camera, BALL.depth(camera), name=f"{azimuth_deg:g}")


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
        fine_views=tuple(view_at(angle, 2 * size) for angle in inputs_deg),
    )
    return inputs, torch.stack([view.image for view in targets])


def analytic_capture(count: int = 12, size: int = 32, name: str = "one") -> FrameSequence:
    """A full turn around the ball on its plane."""
    frames = []
    for index in range(count):
        view = replace(view_at(360 * index / count, size), name=f"{index:03d}.png")
        frames.append(Frame(view.name, view.camera, True, False, _Photograph(view), ()))
    return FrameSequence("apple", name, tuple(frames))


@dataclass(frozen=True)
class _Photograph:
    view: View

    def __call__(self, *, depth: bool = True) -> View:
        return self.view if depth else replace(self.view, depth=None)
