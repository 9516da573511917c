"""Record3D's captures: the folder in an `.r3d`, or the exported sequence of JPEG and EXR files.

Cameras have ARKit's axes, which are OpenGL's; the first one defines the world. Its unit is a metre.
"""

import importlib.util
import logging
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from extrap_train.data.camera_check import OPENGL_POSES
from extrap_train.data.depth_files import DepthFile, find_depth
from extrap_train.data.json_files import read_json, require_dict
from extrap_train.data.listed_files import ListedFiles
from extrap_train.data.listed_photographs import (
    Listed,
    ListedPhotograph,
    sequence_of_photographs,
)
from extrap_train.data.lzfse_files import CONFIDENCE_SUFFIX, DEPTH_SUFFIX
from extrap_train.data.posed_entries import names_faults, photograph_of_entry
from extrap_train.data.sequences import FrameSequence
from extrap_train.errors import InputError
from extrap_train.geometry.foreign_cameras import opengl_from_quaternion

_LAYOUTS = {"metadata": "rgbd", "metadata.json": "rgb"}
"""The description and the folder of the pictures, in an `.r3d` and in an exported sequence."""

log = logging.getLogger(__name__)


def find_metadata(folder: Path) -> Path | None:
    """The description of a Record3D capture, None where there is none."""
    for name, pictures in _LAYOUTS.items():
        if (folder / name).is_file() and (folder / pictures).is_dir():
            return folder / name
    return None


def read_record3d(metadata: Path, name: str) -> FrameSequence:
    """The capture of a description that `find_metadata` found.

    Depth of low confidence is unknown. Depth that cannot be read is left out with a warning.
    """
    content = require_dict(read_json(metadata), "an object with a list `poses`", metadata)
    poses = content.get("poses")
    if not isinstance(poses, list) or not poses:
        raise InputError(
            f"{metadata}: has no poses, which Record3D has for LiDAR videos alone; record one, or "
            "give a folder of the pictures alone to have cameras estimated"
        )
    files = ListedFiles(metadata.parent)
    pictures = _LAYOUTS[metadata.name]
    has_depth = _has_readable_depth(metadata.parent)
    listed = [
        Listed(f"{pictures}/{i}", partial(_photograph, files.root, metadata, content, i, has_depth))
        for i in range(len(poses))
    ]
    return sequence_of_photographs(files, name, listed, metadata, OPENGL_POSES, [])


def _has_readable_depth(folder: Path) -> bool:
    if any((folder / "depth").glob("*.exr")):
        log.warning("%s: EXR depth is left out; share the capture as .r3d to use it", folder)
        return False
    if not any((folder / "rgbd").glob(f"*{DEPTH_SUFFIX}")):
        return False
    if importlib.util.find_spec("lzfse") is None:
        log.warning(
            '%s: its depth is left out; pip install "extrap-train[record3d]" to use it', folder
        )
        return False
    return True


def _photograph(
    root: Path, metadata: Path, content: dict[str, Any], index: int, has_depth: bool, path: str
) -> ListedPhotograph:
    with names_faults(metadata, path):
        pose = torch.tensor(content["poses"][index], dtype=torch.float64)
        if pose.shape != (7,):
            raise ValueError(f"its pose has shape {tuple(pose.shape)}, expected 7 numbers")
        matrix = opengl_from_quaternion(pose[:4], pose[4:]).tolist()
        size = {key: content[key] for key in ("w", "h")}
        entry = size | _lens(content, index) | {"transform_matrix": matrix}
        photo = photograph_of_entry(root, entry, path)
        return replace(photo, depth=_depth(root, index) if has_depth else None)


def _lens(content: dict[str, Any], index: int) -> dict[str, Any]:
    """The frame's own coefficients if there are any, else those of the column-major matrix `K`."""
    if each := content.get("perFrameIntrinsicCoeffs"):
        if len(each) != len(content["poses"]):
            raise ValueError(f"perFrameIntrinsicCoeffs has {len(each)} entries, one for each pose")
        fx, fy, cx, cy = each[index]
    else:
        fx, below, _, skew, fy, _, cx, cy, _ = content["K"]
        if below or skew:
            raise ValueError("K has skew or is not column-major")
    return {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}


def _depth(root: Path, index: int) -> DepthFile | None:
    depth, confidence = (f"rgbd/{index}{suffix}" for suffix in (DEPTH_SUFFIX, CONFIDENCE_SUFFIX))
    return find_depth(root, depth, 1.0, confidence)
