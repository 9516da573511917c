"""Folders with a `transforms.json`, as nerfstudio and instant-ngp write them (OpenGL axes)."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from extrap_train.data.camera_check import OPENGL_POSES
from extrap_train.data.depth_files import DepthFile
from extrap_train.data.json_files import read_json, require_dict, require_list
from extrap_train.data.lens_keys import LENS_KEYS, merge_entry, number_of
from extrap_train.data.listed_files import ListedFiles
from extrap_train.data.listed_photographs import (
    Listed,
    ListedPhotograph,
    pinhole_camera,
    sequence_of_photographs,
)
from extrap_train.data.paths import check_relative
from extrap_train.data.posed_entries import MILLIMETRES, names_faults, photograph_of_entry
from extrap_train.data.sequences import FrameSequence, PointFile
from extrap_train.errors import InputError
from extrap_train.views import Camera, stack_cameras

TRANSFORMS = "transforms.json"
KEYS = LENS_KEYS | {
    *("w", "h", "transform_matrix", "mask_path", "ply_file_path", "applied_scale", "poses"),
    *("depth_file_path", "depth_unit_scale_factor", "depth_path", "integer_depth_scale"),
}
"""Entries read from the top level, where they hold for all frames."""


def read_transforms(folder: Path) -> FrameSequence:
    """The capture in a folder with a `transforms.json`; distortion is undone when a frame is read.

    Size, intrinsics and distortion may stand for a frame alone or for all. The world is the file's,
    whatever `applied_transform` led to it; nerfstudio's depth is scaled along with `applied_scale`.
    Entries without a path or a picture, and those with a camera that cannot be used, are left out.
    """
    file = folder / TRANSFORMS
    files = ListedFiles(folder)
    content, entries = _read_entries(file)
    listed, unusable = [], []
    for index, entry in enumerate(entries):
        try:
            listed.append(_listed_picture(files, content, entry, index, file))
        except InputError as error:
            unusable.append(str(error))
    cloud = content.get("ply_file_path")
    sequence = sequence_of_photographs(
        files,
        folder.resolve().name,
        listed,
        file,
        OPENGL_POSES,
        unusable,
        point_cloud=PointFile(folder, check_relative(str(cloud), file)) if cloud else None,
    )
    source = content.get("poses")
    return replace(sequence, poses=f"{file}, of {source!a:.100}") if source else sequence


def read_cameras(file: Path) -> tuple[list[str], Camera]:
    """Names and pinhole cameras of a file laid out like `transforms.json` that has no pictures.

    Every entry needs a `transform_matrix` and, itself or for all, the size `w`, `h` and a lens. All
    entries must have one size. Raises InputError that names the entry otherwise, or where a name
    is not a path below a folder.
    """
    content, entries = _read_entries(file)
    names, cameras = [], []
    for index, entry in enumerate(entries):
        entry = merge_entry(content, require_dict(entry, f"an object as frame {index}", file))
        path = entry.get("file_path")
        name = f"{index:03d}" if path is None else check_relative(str(path), file)
        if "w" not in entry or "h" not in entry:
            raise InputError(f"{file}: neither the file nor its entry {name} has w and h; add them")
        names.append(name)
        photo = _photograph(ListedFiles(file.parent), entry, file, name)
        cameras.append(pinhole_camera(photo, file))
    sizes = {(camera.height, camera.width) for camera in cameras}
    if len(sizes) != 1:
        raise InputError(f"{file}: its entries have different sizes {sorted(sizes)}; split it")
    return names, stack_cameras(cameras)


def _read_entries(file: Path) -> tuple[dict[str, Any], list[Any]]:
    """What stands for all frames, and the frames."""
    content = require_dict(read_json(file), "an object with a list `frames`", file)
    entries = require_list(content.get("frames"), "frames", file)
    return {key: value for key, value in content.items() if key in KEYS}, entries


def _listed_picture(
    files: ListedFiles, content: dict[str, Any], entry: Any, index: int, file: Path
) -> Listed:
    what = f"an object with a text `file_path` as frame {index}"
    path = require_dict(entry, what, file).get("file_path")
    if not isinstance(path, str):
        raise InputError(f"{file}: expected {what}; correct the entry")
    merged = merge_entry(content, entry)
    for key in ("depth_file_path", "depth_path", "mask_path"):
        if merged.get(key):
            check_relative(str(merged[key]), file)
    return Listed(check_relative(path, file), partial(_photograph, files, merged, file))


def _photograph(
    files: ListedFiles, entry: dict[str, Any], file: Path, path: str
) -> ListedPhotograph:
    with names_faults(file, path):
        mask = entry.get("mask_path")
        return replace(
            photograph_of_entry(files.root, entry, path),
            depth=_depth(files, entry),
            mask_path=_find_or_keep(files, mask) if mask else None,
        )


def _depth(files: ListedFiles, entry: dict[str, Any]) -> DepthFile | None:
    """nerfstudio's files are in millimetres by default; instant-ngp's state their unit."""
    if path := entry.get("depth_file_path"):
        unit = number_of(entry, "depth_unit_scale_factor", MILLIMETRES)
        unit *= number_of(entry, "applied_scale", 1.0)
    elif path := entry.get("depth_path"):
        unit = number_of(entry, "integer_depth_scale")
    else:
        return None
    return DepthFile(_find_or_keep(files, path), unit)


def _find_or_keep(files: ListedFiles, path: Any) -> str:
    """Where a file is; where it is nowhere, its path as it stands, which reading it will report."""
    return files.find(str(path)) or str(path)
