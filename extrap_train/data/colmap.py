"""COLMAP's sparse models as captures: cameras and poses, text and binary.

Read here and not by pycolmap, which trusts the counts that a file states and hangs on damaged ones.
"""

import logging
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import torch

from extrap_train.data.camera_check import COLMAP_POSES
from extrap_train.data.colmap_files import (
    ModelCamera,
    ModelImage,
    read_model_cameras,
    read_model_images,
)
from extrap_train.data.colmap_points import Sighting, check_points
from extrap_train.data.image_files import MAX_PIXELS
from extrap_train.data.listed_files import ListedFiles
from extrap_train.data.listed_photographs import (
    Listed,
    ListedPhotograph,
    sequence_of_photographs,
)
from extrap_train.data.paths import check_relative
from extrap_train.data.sequences import FrameSequence, PointFile
from extrap_train.errors import InputError
from extrap_train.geometry.cuts import Equirectangular
from extrap_train.geometry.foreign_cameras import (
    CAMERA_MODELS,
    lens_from_parameters,
    world_to_cam_from_colmap,
)
from extrap_train.geometry.lens import Lens

POINT_CLOUD = "points3D.ply"
"""Some tools leave one beside the model."""
_KINDS = ("bin", "txt")
_SIGHTINGS = 32
"""Images, at least, whose poses are checked against the points."""

log = logging.getLogger(__name__)


def find_model(folder: Path) -> Path | None:
    """The folder of the model: `folder`, the largest in its `sparse`, `sparse`, or one in `colmap`.

    COLMAP's mapper leaves one model for each part of the photographs that it could connect. Those
    that are not taken are named in a warning.
    """
    if _images_file(folder):
        return folder
    sparse, inner = folder / "sparse", folder / "colmap"
    parts = sorted(path for path in sparse.glob("*") if _images_file(path))
    if not parts:
        found = find_model(inner) if inner.is_dir() else None
        return sparse if _images_file(sparse) else found
    if len(parts) == 1:
        return parts[0]
    counts = {part: _count_images(part) for part in parts}
    largest = max(parts, key=lambda part: counts[part])
    others = [f"{part.name} has {counts[part]}" for part in parts if part != largest]
    log.warning(
        "%s: holds %d models, of which %s with %d pictures is read (%s); name another with "
        "scene=%s/NUMBER",
        sparse,
        len(parts),
        largest.name,
        counts[largest],
        ", ".join(others[:4]),
        sparse,
    )
    return largest


def read_model(model: Path, images: Path, name: str, upright: bool = False) -> FrameSequence:
    """The capture of a COLMAP model; `images` is the folder that its picture names start from.

    Distortion is undone when a frame is read. Entries without a picture, and those with a camera
    that cannot be used, are left out. The cameras of an `upright` model hold the pictures as their
    EXIF orientation turns them.
    """
    images_file = _images_file(model) or model / "images.bin"
    cameras_file = model / f"cameras{images_file.suffix}"
    for file in (cameras_file, images_file):
        if not file.is_file():
            raise InputError(f"{file}: no such file; export the whole COLMAP model")
    cameras, entries = read_model_cameras(cameras_file), read_model_images(images_file)
    if not entries:
        raise InputError(f"{images_file}: lists no picture; run COLMAP again")
    listed, unusable = [], []
    for entry in entries:
        try:
            path = check_relative(entry.name, images_file)
        except InputError as error:
            unusable.append(entry.fault or str(error))
        else:
            listed.append(Listed(path, partial(_photograph, entry, cameras, cameras_file, upright)))
    # First: around the world's origin, poses alone fit several conventions, and points only one.
    check_points(model, _sightings(entries, cameras, cameras_file))
    cloud = PointFile(model, POINT_CLOUD)
    return sequence_of_photographs(
        ListedFiles(images), name, listed, images_file, COLMAP_POSES, unusable, cloud
    )


def _sightings(
    entries: Sequence[ModelImage], cameras: dict[int, ModelCamera], file: Path
) -> list[Sighting]:
    """Some of the images that can be used and are no panoramas, with the points that they show."""
    found = []
    for entry in entries[:: max(1, len(entries) // _SIGHTINGS)]:
        try:
            photo = _photograph(entry, cameras, file, upright=False, path=entry.name)
        except InputError:  # left out
            continue
        if isinstance(photo.lens, Lens):
            pose, size = photo.world_to_cam, (photo.height, photo.width)
            found.append(Sighting(pose, photo.lens, *size, entry.observed))
    return found


def _images_file(folder: Path) -> Path | None:
    """The file that lists a model's images, in binary before text; None where there is none."""
    files = (folder / f"images.{kind}" for kind in _KINDS)
    return next((file for file in files if file.is_file()), None)


def _count_images(model: Path) -> int:
    """0 where the file that lists them is damaged."""
    file = _images_file(model)
    try:
        return len(read_model_images(file)) if file else 0
    except InputError:
        return 0


def _photograph(
    entry: ModelImage, cameras: dict[int, ModelCamera], file: Path, upright: bool, path: str
) -> ListedPhotograph:
    if entry.fault:
        raise InputError(f"{entry.name}: {entry.fault}")
    if entry.camera not in cameras:
        raise InputError(
            f"{file}: {entry.name} names camera {entry.camera}, which the model does not have; "
            "export the model again"
        )
    camera = cameras[entry.camera]
    quaternion = torch.tensor(entry.quaternion_wxyz, dtype=torch.float64)
    translation = torch.tensor(entry.translation, dtype=torch.float64)
    return ListedPhotograph(
        image_path=path,
        height=camera.height,
        width=camera.width,
        lens=_lens(camera, file),
        world_to_cam=world_to_cam_from_colmap(quaternion, translation),
        upright=upright,
    )


def _lens(camera: ModelCamera, file: Path) -> Lens | Equirectangular:
    """InputError where the model cannot be undone or the entry makes no sense."""
    if camera.fault:
        raise InputError(camera.fault)
    model = next((model for model in CAMERA_MODELS if model.name == camera.model), None)
    if model is None:
        raise InputError(
            f"{file}: camera {camera.number} is of the model {camera.model}, and only "
            f"{', '.join(m.name for m in CAMERA_MODELS)} can be undone; run COLMAP's "
            "image_undistorter first"
        )
    where = f"{file}: camera {camera.number} ({model.name})"
    if len(camera.parameters) != len(model.parameters):
        fault = f"{len(camera.parameters)} parameters, expected {len(model.parameters)}"
        raise InputError(f"{where} has {fault}; export the model again")
    height, width = camera.height, camera.width
    named = dict(zip(model.parameters, camera.parameters, strict=True))
    is_size = (named.get("h", height), named.get("w", width)) == (height, width)
    if height <= 0 or width <= 0 or height * width > MAX_PIXELS or not is_size:
        raise InputError(
            f"{where}: its size {height} x {width} is not valid; export the model again"
        )
    return Equirectangular() if "w" in named else lens_from_parameters(named, model.fisheye)
