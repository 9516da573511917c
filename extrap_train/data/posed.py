"""Folders with a `transforms.json`, as nerfstudio and instant-ngp write them (OpenGL axes)."""

import math
import posixpath
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from extrap_train.data.json_files import read_json
from extrap_train.data.paths import check_relative, resolve_inside
from extrap_train.data.photographs import (
    Photograph,
    pinhole_camera,
    present_pictures,
    sequence_of_photographs,
)
from extrap_train.data.picture_files import image_size
from extrap_train.data.sequences import PointCloud, Sequence
from extrap_train.data.validation import require_dict, require_list
from extrap_train.errors import InputError
from extrap_train.geometry.colmap import CAMERA_MODELS, lens_from_parameters
from extrap_train.geometry.lens import Lens
from extrap_train.geometry.opengl import world_to_cam_from_opengl
from extrap_train.views import Camera, stack_cameras

TRANSFORMS = "transforms.json"
MILLIMETRES = 0.001
"""nerfstudio's unit of depth files, in scene units."""

_FISHEYE = {model.name: model.fisheye for model in CAMERA_MODELS} | {"PERSPECTIVE": False}
_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


def read_transforms(folder: Path) -> Sequence:
    """The capture in a folder with a `transforms.json`; distortion is undone when a frame is read.

    Size, intrinsics and distortion may stand for a frame alone or for all. The world is the file's,
    whatever `applied_transform` led to it; depth is scaled along with `applied_scale`. Entries
    without a picture are left out with one warning.
    """
    file = folder / TRANSFORMS
    content = require_dict(read_json(file), "an object with a list `frames`", file)
    entries = require_list(content.get("frames"), "frames", file)
    paths = [_picture_path(folder, entry, index, file) for index, entry in enumerate(entries)]
    present = present_pictures(folder, paths, file)
    cloud = content.get("ply_file_path")
    return sequence_of_photographs(
        folder,
        folder.resolve().name,
        [
            _photograph(folder, path, content | entry, file)
            for path, entry in zip(paths, entries, strict=True)
            if path in present
        ],
        file,
        point_cloud=PointCloud(folder, check_relative(str(cloud), file)) if cloud else None,
    )


def read_cameras(file: Path) -> tuple[list[str], Camera]:
    """Names and pinhole cameras of a file laid out like `transforms.json` that has no pictures.

    Every entry needs a `transform_matrix` and, itself or for all, the size `w`, `h` and a lens. All
    entries must have one size. Raises InputError that names the entry otherwise, or where a name
    is no path below a folder.
    """
    content = require_dict(read_json(file), "an object with a list `frames`", file)
    entries = require_list(content.get("frames"), "frames", file)
    names, cameras = [], []
    for index, entry in enumerate(entries):
        entry = content | require_dict(entry, f"an object as frame {index}", file)
        name = check_relative(str(entry.get("file_path", f"{index:03d}")), file)
        if "w" not in entry or "h" not in entry:
            raise InputError(f"{file}: neither the file nor its entry {name} has w and h; add them")
        names.append(name)
        cameras.append(pinhole_camera(_photograph(file.parent, name, entry, file), file)[1])
    sizes = {(camera.height, camera.width) for camera in cameras}
    if len(sizes) != 1:
        raise InputError(f"{file}: its entries have different sizes {sorted(sizes)}; split it")
    return names, stack_cameras(cameras)


def _picture_path(folder: Path, entry: Any, index: int, file: Path) -> str:
    what = f"an object with a text `file_path` as frame {index}"
    path = require_dict(entry, what, file).get("file_path")
    if not isinstance(path, str):
        raise InputError(f"{file}: expected {what}; correct the entry")
    path = posixpath.normpath(check_relative(path, file))
    if (folder / path).is_file():
        return path
    # Blender's scenes leave the suffix out, and a name may have a dot of its own.
    whole = check_relative(f"{path}.png", file)
    return path if Path(path).suffix and not (folder / whole).is_file() else whole


def _photograph(folder: Path, path: str, entry: dict[str, Any], file: Path) -> Photograph:
    try:
        height, width = _size(folder, path, entry)
        return Photograph(
            image_path=path,
            height=height,
            width=width,
            lens=_lens(entry, height, width),
            world_to_cam=world_to_cam_from_opengl(_matrix(entry["transform_matrix"])),
            depth_path=_optional_path(entry.get("depth_file_path"), file),
            depth_scale=float(entry.get("depth_unit_scale_factor", MILLIMETRES))
            * float(entry.get("applied_scale", 1.0)),
            mask_path=_optional_path(entry.get("mask_path"), file),
        )
    except KeyError as error:
        raise InputError(
            f"{file}: neither the file nor its entry {path} has {error}; add it"
        ) from None
    except InputError:
        raise
    except (TypeError, ValueError, OverflowError, RuntimeError, ZeroDivisionError) as error:
        raise InputError(f"{file}: entry {path} is malformed ({error}); correct it") from None


def _size(folder: Path, picture: str, entry: dict[str, Any]) -> tuple[int, int]:
    if "h" not in entry and "w" not in entry:
        return image_size(resolve_inside(folder, picture))
    height, width = int(entry["h"]), int(entry["w"])
    if height <= 0 or width <= 0:
        raise ValueError(f"image size {height} x {width}")
    return height, width


def _lens(entry: dict[str, Any], height: int, width: int) -> Lens:
    model = entry.get("camera_model", "PERSPECTIVE")
    if model not in _FISHEYE:
        raise ValueError(f"camera model {model!r} is none of {', '.join(_FISHEYE)}")
    if "fl_x" in entry:
        focal = float(entry["fl_x"])
    else:
        focal = width / 2 / math.tan(float(entry["camera_angle_x"]) / 2)
    values = {
        "fx": focal,
        "fy": float(entry.get("fl_y", focal)),
        "cx": float(entry.get("cx", width / 2)),
        "cy": float(entry.get("cy", height / 2)),
    }
    distortion = {name: float(entry[name]) for name in _COEFFICIENTS if name in entry}
    return lens_from_parameters(values | distortion, _FISHEYE[model])


def _matrix(rows: Any) -> Float[Tensor, "4 4"]:
    matrix = torch.tensor(rows, dtype=torch.float64)
    if matrix.shape not in ((4, 4), (3, 4)):
        raise ValueError(f"transform_matrix has shape {tuple(matrix.shape)}, expected 4 x 4")
    return torch.cat([matrix[:3], matrix.new_tensor([[0, 0, 0, 1]])])


def _optional_path(path: Any, file: Path) -> str | None:
    return check_relative(str(path), file) if path else None
