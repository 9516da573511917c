"""The reader against real photographs: features lie on the epipolar lines of its cameras."""

import numpy as np
import pytest
import torch
from two_views import epipolar_distances

from extrap_train.data.co3d import read_category, read_sequence
from extrap_train.data.co3d.annotations import read_sequence_split
from extrap_train.errors import InputError


def test_apple_features_lie_on_their_epipolar_lines(shared):
    root = shared / "data" / "co3d"
    sequence = read_sequence(root, "apple", "apple_20_frames")
    views = [frame.load() for frame in sequence.frames[:4]]
    distances = epipolar_distances(views)
    assert len(distances) > 300
    # Wrong axes or units give 14 px to 100 px.
    assert np.median(distances) < 1


def test_hydrant_masks_are_read(shared):
    root = shared / "data" / "co3d"
    (sequence,) = read_category(root, "hydrant")
    assert len(sequence.frames) == 5
    view = sequence.frames[2].load()
    assert view.image.shape[1:] == view.mask.shape == (view.camera.height, view.camera.width)
    assert 0.02 < view.mask.mean() < 0.5
    rows, columns = torch.nonzero(view.mask > 0.5, as_tuple=True)
    centre = torch.stack([columns.float().mean(), rows.float().mean()])
    size = torch.tensor([view.camera.width, view.camera.height])
    assert ((centre / size - 0.5).abs() < 0.25).all()


def test_a_many_view_list_holds_no_sequence_out(shared):
    with pytest.raises(InputError, match="manyview_dev_0"):
        read_sequence_split(shared / "data" / "co3d", "apple", "manyview_dev_0")
