"""What passes between this project and a network in an environment of its own: NPZ files.

Needs NumPy and Pillow alone. docs/depth_files.md describes both folders.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image


@dataclass
class Photograph:
    """A whole photograph without distortion, and its camera at its size."""

    name: str
    """Below the folder, without a suffix."""
    image: np.ndarray
    """height × width × 3, 8 bits."""
    intrinsics: np.ndarray
    """3 × 3; the first pixel's centre is 0.5."""
    world_to_cam: np.ndarray
    """4 × 4, OpenCV axes."""


def read_photographs(folder: str, longest: int, multiple: int = 14) -> list[Photograph]:
    """The photographs that `write_photographs.py` wrote, by name, resized as a whole.

    The longer side becomes `longest`, and both sides multiples of `multiple`. Ends the program if
    there are none, or if they differ in size.
    """
    found = []
    for file in sorted(Path(folder).rglob("*.npz")):
        with np.load(file, allow_pickle=False) as stored:
            image, k, pose = (stored[n] for n in ("image", "intrinsics", "world_to_cam"))
        height, width = image.shape[:2]
        scale = longest / max(height, width)
        sides = [max(1, round(side * scale / multiple)) * multiple for side in (width, height)]
        small = np.asarray(Image.fromarray(image).resize(sides, Image.Resampling.LANCZOS))
        k = np.diag([sides[0] / width, sides[1] / height, 1]) @ k
        name = file.relative_to(folder).with_suffix("").as_posix()
        found.append(Photograph(name, small, k, pose.astype(float)))
    if len({photograph.image.shape for photograph in found}) != 1:
        sys.exit(f"{folder}: {len(found)} photographs, not some of one size; write others")
    return found


def write_depth(
    folder: str, photograph: Photograph, depth: np.ndarray, raw_confidence: np.ndarray
) -> None:
    """Write one photograph's depth, of the image's size, for `depth=files`.

    The networks' confidences c lie between 1 and infinity; stored is 1 − 1/c.
    """
    file = Path(folder, f"{photograph.name}.npz")
    file.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(
        file,
        depth=np.asarray(depth, np.float32),
        confidence=(1 - 1 / np.maximum(raw_confidence, 1)).astype(np.float32),
        intrinsics=photograph.intrinsics,
        world_to_cam=photograph.world_to_cam,
    )
