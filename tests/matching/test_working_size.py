import torch

from extrap_train.geometry.cameras import pixel_grid
from extrap_train.matching import resize, to_grey, to_image_pixels


def test_pixels_of_a_smaller_copy_show_the_same():
    grid = pixel_grid(120, 200).permute(2, 0, 1) / 200
    picture = torch.cat([grid, grid[:1]])
    working = resize(picture, 40, 80)
    indices = torch.tensor([[20.0, 11.0], [60.0, 30.0]])  # whole numbers are centres
    columns, rows = indices.long().T
    shown = working[:2, rows, columns].T * 200
    torch.testing.assert_close(
        to_image_pixels(indices, working.shape, picture.shape), shown, atol=0.1, rtol=0
    )


def test_grey_is_rec_601():
    assert torch.allclose(to_grey(torch.eye(3)[:, None]), torch.tensor([[0.299, 0.587, 0.114]]))
