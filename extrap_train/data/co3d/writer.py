"""Our own captures in the layout of CO3D's second release, so that one reader serves both.

The same views give the same bytes, and every file is there whole or not at all.
"""

import gzip
import io
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from plyfile import PlyData, PlyElement
from torch import Tensor

from extrap_train.data.co3d import FRAME_ANNOTATIONS, SEQUENCE_ANNOTATIONS
from extrap_train.data.image_files import png_bytes, to_eight_bits
from extrap_train.geometry.foreign_cameras import viewpoint_from_camera
from extrap_train.store.atomic import write_atomic
from extrap_train.views import Camera, View

JPEG_QUALITY = 95
EXACT_QUALITY = 1.0
"""CO3D's quality scores rate an estimate; ours are not estimates."""


def write_frame(
    root: Path, category: str, sequence_name: str, frame_number: int, view: View
) -> dict[str, Any]:
    """Write a view's image, depth and mask; returns its entry for `write_annotations`.

    Depth is rounded to float16, as CO3D does: 11 significant bits, at most 65,504 scene units.
    """
    folder, stem = f"{category}/{sequence_name}", f"frame{frame_number:06d}"
    image_path = f"{folder}/images/{stem}.jpg"
    write_atomic(root / image_path, _jpeg(view.image))
    return {
        "sequence_name": sequence_name,
        "frame_number": frame_number,
        "frame_timestamp": float(frame_number),
        "image": {"path": image_path, "size": [view.camera.height, view.camera.width]},
        "depth": None if view.depth is None else _write_depth(root, folder, stem, view.depth),
        "mask": None if view.mask is None else _write_mask(root, folder, stem, view.mask),
        "viewpoint": _viewpoint(view.camera),
        "meta": None,
    }


def write_sequence(
    root: Path,
    category: str,
    sequence_name: str,
    points: Float[Tensor, "n 3"],
    colors: Float[Tensor, "n 3"],
) -> dict[str, Any]:
    """Write the point cloud, colours in [0, 1]; returns the entry for `write_annotations`."""
    path = f"{category}/{sequence_name}/pointcloud.ply"
    write_atomic(root / path, _ply(points, colors))
    return {
        "sequence_name": sequence_name,
        "category": category,
        "video": None,
        "point_cloud": {"path": path, "quality_score": EXACT_QUALITY, "n_points": len(points)},
        "viewpoint_quality_score": EXACT_QUALITY,
    }


def write_annotations(
    root: Path,
    category: str,
    frame_entries: Iterable[Mapping[str, Any]],
    sequence_entries: Iterable[Mapping[str, Any]],
    splits: Mapping[str, Sequence[str]],
) -> None:
    """Write a category's annotations and set list; `splits` gives the sequences of `train`, `test`.

    Frame annotations come last: a category without them is not there yet.
    """
    frames = sorted(
        frame_entries, key=lambda entry: (entry["sequence_name"], entry["frame_number"])
    )
    sequences = sorted(sequence_entries, key=lambda entry: entry["sequence_name"])
    subsets = {
        subset: [
            [entry["sequence_name"], entry["frame_number"], entry["image"]["path"]]
            for entry in frames
            if entry["sequence_name"] in splits.get(subset, ())
        ]
        for subset in ("train", "val", "test")
    }
    folder = root / category
    write_atomic(
        folder / "set_lists" / "set_lists_manyview_dev_0.json", json.dumps(subsets).encode()
    )
    write_atomic(folder / SEQUENCE_ANNOTATIONS, _jgz(sequences))
    write_atomic(folder / FRAME_ANNOTATIONS, _jgz(frames))


def _write_depth(root: Path, folder: str, stem: str, depth: Float[Tensor, "h w"]) -> dict[str, Any]:
    half = depth.cpu().to(torch.float16)
    if not half.isfinite().all() or (half < 0).any():
        raise ValueError("depth must be finite, not negative and within the range of float16")
    path = f"{folder}/depths/{stem}.jpg.geometric.png"
    mask_path = f"{folder}/depth_masks/{stem}.png"
    write_atomic(root / path, png_bytes(half.numpy().view(np.uint16)))
    write_atomic(root / mask_path, png_bytes((half > 0).numpy()))
    return {"path": path, "scale_adjustment": 1.0, "mask_path": mask_path}


def _write_mask(root: Path, folder: str, stem: str, mask: Float[Tensor, "h w"]) -> dict[str, Any]:
    path = f"{folder}/masks/{stem}.png"
    write_atomic(root / path, png_bytes(to_eight_bits(mask)))
    return {"path": path, "mass": float(mask.sum())}


def _viewpoint(camera: Camera) -> dict[str, Any]:
    # In double precision the reader finds the same float32 camera again, bit for bit.
    viewpoint = viewpoint_from_camera(
        Camera(
            camera.world_to_cam.cpu().double(),
            camera.intrinsics.cpu().double(),
            camera.height,
            camera.width,
        )
    )
    return {
        "R": viewpoint.rotation.tolist(),
        "T": viewpoint.translation.tolist(),
        "focal_length": viewpoint.focal_length.tolist(),
        "principal_point": viewpoint.principal_point.tolist(),
        "intrinsics_format": viewpoint.intrinsics_format,
    }


def _jpeg(image: Float[Tensor, "3 h w"]) -> bytes:
    content = io.BytesIO()
    picture = Image.fromarray(to_eight_bits(image.permute(1, 2, 0)))
    # subsampling=0 is 4:4:4: halved chroma would bleed across the edges that warps are judged by.
    picture.save(content, "JPEG", quality=JPEG_QUALITY, subsampling=0)
    return content.getvalue()


def _jgz(content: Any) -> bytes:
    # Without the time of writing, equal content gives equal bytes.
    return gzip.compress(json.dumps(content).encode(), compresslevel=6, mtime=0)


def _ply(points: Float[Tensor, "n 3"], colors: Float[Tensor, "n 3"]) -> bytes:
    kinds = [(axis, "<f4") for axis in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")]
    vertices = np.empty(len(points), dtype=kinds)
    columns = np.c_[points.cpu().numpy(), to_eight_bits(colors)].T
    for (name, _), column in zip(kinds, columns, strict=True):
        vertices[name] = column
    content = io.BytesIO()
    PlyData([PlyElement.describe(vertices, "vertex")], byte_order="<").write(content)
    return content.getvalue()
