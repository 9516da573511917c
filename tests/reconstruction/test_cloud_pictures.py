"""The pictures of the growing cloud."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scenes
import torch
from PIL import Image

from extrap_train.geometry.cameras import project
from extrap_train.reconstruction.cloud import PointCloud
from extrap_train.reconstruction.cloud_pictures import FRAMED, PICTURE_SIZE, draw_growth, framed
from extrap_train.reconstruction.global_map import GENERATED, GIVEN, GlobalMap, Origin
from extrap_train.views import View, combine, stack_cameras


def _cloud(points: torch.Tensor, view: int = 0) -> PointCloud:
    count = len(points)
    red = torch.tensor([1.0, 0.0, 0.0]).expand(count, 3)
    return PointCloud(points, red, -points, torch.ones(count), torch.full((count,), view))


@pytest.mark.parametrize("extent", [0.1, 1.0, 10.0])
def test_a_cloud_of_any_extent_fits_into_the_picture_and_fills_it(extent: float) -> None:
    cameras = stack_cameras([scenes.orbit_camera(a, size=64) for a in (0.0, 180.0)])
    generator = torch.Generator().manual_seed(0)
    cloud = _cloud(extent * (torch.rand(5000, 3, generator=generator) - 0.5))
    moved = framed(cameras, cloud)
    shares = []
    for index in range(2):
        pixels, depth = project(cloud.points, moved[index])
        inside = (depth > 0) & (pixels >= 0).all(-1) & (pixels < 64).all(-1)
        shares.append(float(inside.float().mean()))
    assert min(shares) == pytest.approx(FRAMED, abs=0.003)
    assert torch.allclose(moved.center.norm(dim=-1), moved.center[0].norm(), rtol=1e-3)


def test_the_last_picture_of_the_strip_shows_what_lies_far_out(tmp_path: Path) -> None:
    """A ring as wide as the cameras' orbit, that the generated view adds to a ball."""
    known = GlobalMap(0.01)
    for index in range(3):
        camera = scenes.orbit_camera(40.0 * index, elevation_deg=30.0, size=16)
        view = View(torch.rand(3, 16, 16), camera, torch.ones(16, 16), name=str(index))
        origin = Origin(GENERATED if index == 2 else GIVEN, root=0)
        known, _ = known.added(view, torch.ones(16, 16), origin)
    radius = float(known.cameras.center[0].norm())
    turn = torch.linspace(0, 2 * torch.pi, 400)
    ring = radius * torch.stack([turn.cos(), torch.zeros(400), turn.sin()], 1)
    ball = 0.1 * torch.randn(400, 3, generator=torch.Generator().manual_seed(0))
    far = replace(_cloud(ring, view=2), colors=torch.tensor([0.0, 0.0, 1.0]).expand(400, 3))
    both = combine([_cloud(ball), far], lambda tensors: torch.cat(list(tensors)))
    draw_growth(known, both, tmp_path / "growth.png")
    strip = np.asarray(Image.open(tmp_path / "growth.png").convert("RGB")).astype(int)
    blue = strip[..., 2] - strip[..., 0] > 150
    columns = np.flatnonzero(blue.any(0))
    assert columns.min() >= PICTURE_SIZE  # not after the inputs
    assert np.ptp(columns) > 0.8 * PICTURE_SIZE
