"""Real photographs. The numbers: `pytest -s -m "" tests/depth/test_stereo_on_photographs.py`."""

import numpy as np
import pytest
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from extrap_train.config import StereoConfig
from extrap_train.data.co3d import read_category
from extrap_train.depth.stereo import PlaneSweepStereo, forward_backward_error
from extrap_train.views import Camera, View

FOCAL, BASELINE, OFFSET = 994.978, 193.001, 31.086
"""The motorcycle pair's calibration: pixels, millimetres, pixels between the principal points."""


def motorcycle() -> tuple[View, View, Float[Tensor, "h w"]]:
    """Left and right view at half resolution, and the left one's disparity in its pixels."""
    data = pytest.importorskip("skimage.data")
    try:
        left, right, disparity = data.stereo_motorcycle()
    except (ModuleNotFoundError, OSError) as error:
        pytest.skip(f"the motorcycle pair is not installed and cannot be downloaded: {error}")
    height, width = disparity.shape

    def view(pixels: np.ndarray, offset: float, x: float) -> View:
        intrinsics = torch.tensor([[FOCAL, 0, 311.193 + offset], [0, FOCAL, 254.877], [0, 0, 1]])
        world_to_cam = torch.eye(4)
        world_to_cam[0, 3] = -x
        image = torch.from_numpy(pixels).permute(2, 0, 1) / 255
        camera = Camera(world_to_cam, intrinsics, height, width)
        return View(image, camera).resized(height // 2, width // 2)

    known = torch.from_numpy(np.where(np.isfinite(disparity), disparity, 0)).float()
    half = functional.interpolate(
        known[None, None], (height // 2, width // 2), mode="nearest-exact"
    )[0, 0] * (width // 2 / width)
    return view(left, 0, 0), view(right, OFFSET, BASELINE), half


def test_motorcycle_disparity():
    left, right, disparity = motorcycle()
    width = left.camera.width
    found = PlaneSweepStereo(StereoConfig(image_size=width)).depth_map(left, [right])
    estimate = (FOCAL * BASELINE / found.depth - OFFSET) * width / 741
    known = disparity > 0
    error = (estimate - disparity).abs()
    share = (error[known] <= 2).float().mean()
    sure = (error[known & (found.reliable() > 0)] <= 2).float().mean()
    print(f"within 2 px: {share:.3f} of all pixels, {sure:.3f} of the reliable ones")
    assert share >= 0.75
    assert sure >= 0.92


@pytest.mark.slow
def test_apple_returns_to_where_it_started(shared):
    sequence = read_category(shared / "data" / "co3d", "apple")[0]
    views = []
    for frame in sequence.frames:
        view = frame.load()
        scale = 256 / max(view.camera.height, view.camera.width)
        size = round(view.camera.height * scale), round(view.camera.width * scale)
        views.append(view.resized(*size))
    stereo = PlaneSweepStereo(StereoConfig())
    inverse = [1 / found.depth for found in stereo.depth_maps(views)]
    nearest, anywhere = [], []
    for i, (view, others) in enumerate(zip(views, stereo.neighbours(views), strict=True)):
        errors = torch.stack(
            [
                forward_backward_error(inverse[i], view.camera, inverse[j], views[j].camera)
                for j in others
            ]
        )
        nearest.append(errors[errors.isfinite()] <= 1.5)
        anywhere.append((errors.amin(0) <= 1.5).flatten())
    in_pairs, in_any = torch.cat(nearest).float().mean(), torch.cat(anywhere).float().mean()
    print(f"≤ 1.5 px: {in_pairs:.3f} of pixels inside a pair, {in_any:.3f} in any neighbour")
    assert in_pairs >= 0.6
    assert in_any >= 0.6
