"""`synthetic:category/0003` is the sequence that training and testing with synthetic data see."""

import pytest
import torch

from data_prep.synthesize import synthesize
from extrap_train.config import SyntheticConfig
from extrap_train.data.co3d import read_category
from extrap_train.data.scene_spec import open_scene
from extrap_train.errors import InputError
from extrap_train.jobs.local import LocalLauncher

SMALL = SyntheticConfig(test_sequences=1, train_sequences=1, frames=3, image_size=24)


def test_it_is_what_lies_on_disk_before_compression(tmp_path):
    synthesize(SMALL, "cup", tmp_path, LocalLauncher(1))
    stored = read_category(tmp_path, "cup")[1]
    rendered = open_scene("synthetic:cup/0001", SMALL)
    assert (rendered.category, rendered.name) == ("cup", stored.name) == ("cup", "0001")
    for one, other in zip(stored.frames, rendered.frames, strict=True):
        torch.testing.assert_close(one.camera, other.camera, atol=1e-4, rtol=0)
        saved, exact = one.load(), other.load()
        assert (saved.image - exact.image).abs().mean() < 0.03, "JPEG alone tells them apart"
        torch.testing.assert_close(saved.depth, exact.depth, atol=0.01, rtol=2e-3)
        assert ((saved.mask > 0.5) == (exact.mask > 0.5)).all()


@pytest.mark.parametrize(
    ("spec", "expected"),
    [
        ("synthetic:hydrant", "is not synthetic:category/NUMBER"),
        ("synthetic:hydrant/-1", "is not synthetic:category/NUMBER"),
        ("synthetic:hydrant/three", "is not synthetic:category/NUMBER"),
        ("synthetic:dragon/0003", "no synthetic category 'dragon'"),
    ],
)
def test_what_is_no_synthetic_scene(spec, expected):
    with pytest.raises(InputError, match=expected):
        open_scene(spec)
