"""Contact sheets: where tiles, titles and captions stand."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from extrap_train.figures import draw_contact_sheet

GREY = torch.tensor([0.2, 0.6])[:, None, None, None].expand(2, 3, 64, 64)
"""Two rows: 51 and 153 of 255."""


def sheet(path: Path, *captions: str) -> np.ndarray:
    draw_contact_sheet({"left": GREY, "right": 1 - GREY}, path / "sheet.png", captions)
    return np.asarray(Image.open(path / "sheet.png"))


def test_a_sheet_without_captions_is_tiles_under_titles(tmp_path: Path) -> None:
    pixels = sheet(tmp_path)
    assert pixels.shape == (20 + 2 * 132, 2 * 132, 3)
    assert (pixels[20:148, :128] == 51).all()
    assert (pixels[152:280, 132:260] == 102).all()


def test_a_caption_stands_above_its_row_and_changes_nothing_else(tmp_path: Path) -> None:
    pixels = sheet(tmp_path, "40°, cup/one, 5 → 17", "50°,\ncup/two, 6 → 18")
    assert pixels.shape == (20 + 2 * 148, 2 * 132, 3)
    assert (pixels[36:164, :128] == 51).all()
    assert (pixels[184:312, 132:260] == 102).all()
    captions = pixels[20:36], pixels[168:184]
    assert all((caption < 128).any() for caption in captions)
    other = sheet(tmp_path, "40°, cup/one, 5 → 17", "9°, cup/three, 1 → 2")
    changed = (pixels != other).any((1, 2)).nonzero()[0]
    assert len(changed)
    assert changed.min() >= 168
    assert changed.max() < 184


def test_a_caption_too_few_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="zip"):
        sheet(tmp_path, "one")
