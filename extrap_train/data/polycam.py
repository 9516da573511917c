"""Polycam's raw export: a JSON with the camera of each keyframe, and LiDAR depth.

Cameras have ARKit's axes, which are OpenGL's; the world's +Y is up and its unit a metre.
"""

import logging
from dataclasses import replace
from functools import partial
from pathlib import Path

from extrap_train.data.camera_check import OPENGL_POSES
from extrap_train.data.depth_files import DepthFile, find_depth
from extrap_train.data.json_files import read_json, require_dict
from extrap_train.data.lens_keys import number_of
from extrap_train.data.listed_files import ListedFiles
from extrap_train.data.listed_photographs import (
    Listed,
    ListedPhotograph,
    sequence_of_photographs,
)
from extrap_train.data.paths import check_relative
from extrap_train.data.posed_entries import MILLIMETRES, names_faults, photograph_of_entry
from extrap_train.data.sequences import FrameSequence
from extrap_train.errors import InputError

KEYFRAMES = "keyframes"
_OPTIMISED, _TRACKED = "corrected_cameras", "cameras"
"""Folders with poses after Polycam's bundle adjustment, and as ARKit tracked them."""
_UNDISTORTED = "corrected_images"
_KEYS = {"w": "width", "h": "height", "fl_x": "fx", "fl_y": "fy", "cx": "cx", "cy": "cy"}

log = logging.getLogger(__name__)


def find_keyframe_cameras(folder: Path) -> Path | None:
    """The folder with the best cameras of a raw export, None where there are none."""
    places = (folder / KEYFRAMES / name for name in (_OPTIMISED, _TRACKED))
    return next((place for place in places if any(place.glob("*.json"))), None)


def read_polycam(cameras: Path, name: str) -> FrameSequence:
    """The capture of a raw export from the folder with its `cameras`.

    Optimised cameras belong to the undistorted pictures, if there are any. Depth of low confidence
    is unknown.
    """
    keyframes = cameras.parent
    images = "images"
    if cameras.name == _TRACKED:
        log.warning(
            "%s: there is no %s, so poses are as ARKit tracked them and may drift; Polycam "
            "optimises those of captures with up to about 700 keyframes",
            keyframes,
            _OPTIMISED,
        )
    elif (keyframes / _UNDISTORTED).is_dir():
        images = _UNDISTORTED
    files = ListedFiles(keyframes.parent)
    listed, unusable = [], []
    for file in sorted(cameras.glob("*.json")):
        try:
            path = check_relative(f"{KEYFRAMES}/{images}/{file.stem}", file)
        except InputError as error:
            unusable.append(str(error))
        else:
            listed.append(Listed(path, partial(_photograph, files.root, file)))
    return sequence_of_photographs(files, name, listed, cameras, OPENGL_POSES, unusable)


def _photograph(root: Path, file: Path, path: str) -> ListedPhotograph:
    with names_faults(file, path):
        content = require_dict(read_json(file), "an object with a camera", file)
        entry = {key: number_of(content, said) for key, said in _KEYS.items()}
        matrix = [[number_of(content, f"t_{row}{c}") for c in range(4)] for row in range(3)]
        photo = photograph_of_entry(root, entry | {"transform_matrix": matrix}, path)
        return replace(photo, depth=_depth(root, file.stem))


def _depth(root: Path, stem: str) -> DepthFile | None:
    depth, confidence = (f"{KEYFRAMES}/{kind}/{stem}.png" for kind in ("depth", "confidence"))
    return find_depth(root, depth, MILLIMETRES, confidence)
