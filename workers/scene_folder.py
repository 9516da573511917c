"""What passes between this project and a network in an environment of its own: files.

Needs NumPy and Pillow alone. docs/depth_files.md describes the folders.
"""

import json
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageOps

SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp")
ORIENTATION = 0x0112
"""EXIF's tag; 1 is upright."""
OPENGL_AXES = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass
class Photograph:
    """A whole photograph, and its camera at its size if that is known."""

    name: str
    """Below the folder of depth, without `.npz`."""
    image: np.ndarray
    """height × width × 3, 8 bits."""
    file: Path
    """As it was read."""
    size: tuple[int, int]
    """Width and height of the photograph before it was resized."""
    intrinsics: np.ndarray | None = None
    """3 × 3; the first pixel's centre is 0.5. The photograph has no distortion."""
    world_to_cam: np.ndarray | None = None
    """4 × 4, OpenCV axes."""


def read_photographs(folder: str, longest: int, multiple: int = 14) -> list[Photograph]:
    """The photographs that `write_photographs.py` wrote, by name, resized as a whole; or, without
    cameras and turned upright, those of any folder or its `images`.

    The longer side becomes `longest`, and both sides multiples of `multiple`. Ends the program if
    there are none, or if they differ in size.
    """
    read = (_read_written(file, folder) for file in sorted(Path(folder).rglob("*.npz")))
    found = [_resized(photograph, longest, multiple) for photograph in read]
    for place in (Path(folder), Path(folder, "images")):
        read = (_read_picture(file) for file in sorted(place.glob("*")) if _is_one(file))
        found = found or [_resized(photograph, longest, multiple) for photograph in read]
    if len({photograph.size for photograph in found}) != 1:
        sys.exit(f"{folder}: {len(found)} photographs, not some of one size; write others")
    return found


def _read_written(file: Path, folder: str) -> Photograph:
    with np.load(file, allow_pickle=False) as stored:
        image, k, pose = (stored[name] for name in ("image", "intrinsics", "world_to_cam"))
    name = file.relative_to(folder).with_suffix("").as_posix()
    return Photograph(name, image, file, image.shape[1::-1], k, pose.astype(float))


def _read_picture(file: Path) -> Photograph:
    with Image.open(file) as picture:
        image = np.asarray(ImageOps.exif_transpose(picture).convert("RGB"))
    return Photograph(f"images/{file.name}", image, file, image.shape[1::-1])


def _resized(photograph: Photograph, longest: int, multiple: int) -> Photograph:
    width, height = photograph.size
    scale = longest / max(height, width)
    sides = [max(1, round(side * scale / multiple)) * multiple for side in (width, height)]
    small = Image.fromarray(photograph.image).resize(sides, Image.Resampling.LANCZOS)
    photograph.image = np.asarray(small)
    if photograph.intrinsics is not None:
        zoom = np.diag([sides[0] / width, sides[1] / height, 1])
        photograph.intrinsics = zoom @ photograph.intrinsics
    return photograph


def _is_one(file: Path) -> bool:
    """Whether a file is a photograph and no mask beside one."""
    return file.suffix.lower() in SUFFIXES and not file.stem.endswith("_mask")


def write_cameras(
    folder: str,
    photographs: list[Photograph],
    intrinsics: np.ndarray,
    world_to_cam: np.ndarray,
    source: str,
) -> str:
    """Give photographs the cameras that a network found, at the images' size, and make the folder a
    scene: upright copies of the photographs and a `transforms.json`, in which `source` is named.

    Returns the folder for its depth: not the scene's, where a photograph in PNG would pass for a
    depth map. Shapes are (…, n, 3, 3) and (…, n, 3 or 4, 4), with OpenCV axes.
    """
    place = photographs[0].file.parent.resolve()
    if Path(folder).resolve() in (place, place.parent if place.name == "images" else place):
        sys.exit(f"{folder}: holds the photographs; give another folder for the scene")
    Path(folder, "images").mkdir(parents=True, exist_ok=True)
    frames = []
    rows = world_to_cam.reshape(len(photographs), -1, 4)[:, :3].astype(float)
    lenses = intrinsics.reshape(len(photographs), 3, 3).astype(float)
    for photograph, k, pose in zip(photographs, lenses, rows, strict=True):
        photograph.intrinsics = k
        photograph.world_to_cam = np.vstack([pose, [0, 0, 0, 1]])
        copy = Path(folder, photograph.name)
        with Image.open(photograph.file) as picture:
            if picture.getexif().get(ORIENTATION, 1) != 1:
                ImageOps.exif_transpose(picture).save(copy, quality=95)
            else:
                shutil.copyfile(photograph.file, copy)
        width, height = photograph.size
        zoom = width / photograph.image.shape[1], height / photograph.image.shape[0]
        frames.append(
            {
                **{"file_path": photograph.name, "w": width, "h": height},
                **{"fl_x": k[0, 0] * zoom[0], "fl_y": k[1, 1] * zoom[1]},
                **{"cx": k[0, 2] * zoom[0], "cy": k[1, 2] * zoom[1]},
                "transform_matrix": (np.linalg.inv(photograph.world_to_cam) @ OPENGL_AXES).tolist(),
            }
        )
    content = json.dumps({"poses": source, "frames": frames}, indent=1)
    Path(folder, "transforms.json").write_text(content, encoding="utf-8")
    return str(Path(folder, "depth"))


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
