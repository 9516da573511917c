"""`python -m data_prep.gallery OUT.jpg`: the picture of the synthetic categories in the README."""

import argparse
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from extrap_train.config import CATEGORIES, SyntheticConfig
from extrap_train.data.synthetic import build_scene, handheld_orbit, render, walk_seed


def gallery(sequences: int, views: int, image_size: int) -> Float[Tensor, "3 h w"]:
    """A row a category: the first of the default test sequences, each from several sides."""
    return torch.cat([_row(c, sequences, views, image_size) for c in CATEGORIES], 1)


def _row(category: str, sequences: int, views: int, image_size: int) -> Float[Tensor, "3 h w"]:
    options = SyntheticConfig()
    images = []
    for index in range(sequences):
        scene = build_scene(category, index, options.seed)
        seed = walk_seed(category, index, options.seed)
        cameras = handheld_orbit(scene, options.frames, image_size, seed)
        chosen = np.arange(views) * options.frames // views
        images += [render(scene, cameras[int(number)]).image for number in chosen]
    return torch.cat(images, 2)


def main() -> None:
    """Draw the gallery into the file named on the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--sequences", type=int, default=4)
    parser.add_argument("--views", type=int, default=3)
    parser.add_argument("--image-size", type=int, default=112)
    options = parser.parse_args()
    picture = gallery(options.sequences, options.views, options.image_size)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    pixels = (picture.permute(1, 2, 0) * 255).round().byte().numpy()
    Image.fromarray(pixels).save(options.out, quality=88)
    print(options.out)


if __name__ == "__main__":
    main()
