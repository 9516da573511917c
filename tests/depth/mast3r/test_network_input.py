import pytest
import torch

from extrap_train.depth import DepthMap
from extrap_train.depth.mast3r.network.crop import crop_for, network_input
from extrap_train.depth.mast3r.source import undo_crop
from extrap_train.errors import InputError
from extrap_train.geometry.cameras import pixel_grid, project, unproject_to_world
from extrap_train.views import Camera, View


def ramp(height: int, width: int) -> View:
    """A view whose red and green say where in the picture a pixel lies."""
    grid = pixel_grid(height, width) / torch.tensor([width, height])
    image = torch.stack([grid[..., 0], grid[..., 1], torch.zeros(height, width)])
    intrinsics = torch.tensor([[300.0, 0, 0.45 * width], [0, 320, 0.55 * height], [0, 0, 1]])
    return View(image, Camera(torch.eye(4), intrinsics, height, width), name="frame7.jpg")


@pytest.mark.parametrize(
    ("size", "square", "expected"),
    [
        ((1066, 1896), False, (288, 512)),  # 16:9
        ((1896, 1066), False, (512, 288)),
        ((480, 640), False, (384, 512)),
        ((600, 600), False, (384, 512)),
        ((600, 600), True, (512, 512)),
        ((90, 128), False, (352, 512)),  # enlarged
    ],
)
def test_sizes_are_multiples_of_the_patch(size, square, expected):
    view = crop_for(ramp(*size), 512, 16, square).apply(ramp(*size))
    assert (view.camera.height, view.camera.width) == expected
    assert view.image.shape[1:] == expected


@pytest.mark.parametrize("size", [(300, 400), (470, 300), (310, 310)])
def test_intrinsics_follow_resampling_and_crop(size):
    view = ramp(*size)
    small = crop_for(view, 128, 16, False).apply(view)
    # A point of the world is seen at the pixel of either picture that shows the same colour.
    points = unproject_to_world(
        torch.full((small.camera.height, small.camera.width), 2.0), small.camera
    )
    pixels, _ = project(points.flatten(0, 1), view.camera)
    colours = small.image[:2].flatten(1).T * torch.tensor([size[1], size[0]])
    inner = torch.zeros(small.camera.height, small.camera.width, dtype=torch.bool)
    inner[3:-3, 3:-3] = True  # where no border is averaged in
    error = (pixels - colours).norm(dim=-1)[inner.flatten()]
    assert error.max() < 0.1  # pixels; half a pixel of the small picture is over one here


def test_depth_returns_to_its_pixels_and_is_unknown_outside_the_crop():
    view = ramp(310, 310)
    crop = crop_for(view, 128, 16, False)
    truth = 2 + view.image[0] + view.image[1]
    small = crop.apply(View(view.image, view.camera, truth))
    depth = 2 + small.image[0] + small.image[1]
    back = undo_crop(crop, DepthMap(depth, torch.ones_like(depth)), 310, 310)
    known = back.confidence > 0
    assert 0.7 < known.float().mean() < 0.8  # three quarters
    assert not known[:30].any()
    assert (back.depth - truth)[known].abs().max() < 0.02
    assert not back.depth[~known].any()


def test_colours_are_centred():
    view = ramp(16, 16)
    found = network_input(
        View(torch.tensor([0.0, 0.5, 1.0]).view(3, 1, 1), view.camera), torch.device("cpu")
    )
    assert found.flatten().tolist() == [-1, 0, 1]


def test_a_sliver_is_refused_by_name():
    with pytest.raises(InputError, match=r"frame7\.jpg: 4 x 400 pixels are too narrow"):
        crop_for(ramp(4, 400), 512, 16, False)
